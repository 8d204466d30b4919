"""The user's cache folder: where it is, and how folders and texts in it are written and removed."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from envhub_sandbox.errors import SnapshotError
from envhub_sandbox.system import folders
from envhub_sandbox.system.files import write_whole_file
from envhub_sandbox.system.platform import IS_WINDOWS

CACHE_VARIABLE = "ENVHUB_CACHE"
BUILDING = ".building-"
_MAX_TEXT_BYTES = 16 * 1024 * 1024


def cache_root() -> Path:
    """``$ENVHUB_CACHE``, or the user's cache folder for ``envhub-sandbox``.

    Raises:
        SnapshotError: The user has none.
    """
    chosen = os.environ.get(CACHE_VARIABLE)
    if chosen:
        return Path(os.path.abspath(os.path.expanduser(chosen)))
    import platformdirs

    try:
        return Path(platformdirs.user_cache_dir("envhub-sandbox", appauthor=False))
    except RuntimeError:
        raise SnapshotError(
            f"this user has no home folder for the cache; set {CACHE_VARIABLE} to a folder"
        ) from None


@contextlib.contextmanager
def draft(folder: Path, prefix: str = BUILDING) -> Iterator[Path]:
    """A new folder (0700) to be filled and then renamed into place; otherwise it is removed."""
    made = Path(tempfile.mkdtemp(prefix=prefix, dir=folder))
    try:
        made.chmod(folders.PRIVATE_MODE)
        yield made
    finally:
        remove_tree(made)


def remove_tree(path: Path) -> None:
    """Remove a folder of the cache, whose own folders are read-only; nothing if it is gone.

    Without recursion, as ``shutil.rmtree`` has it: of a package, a stranger chose how deep it is.
    """
    found = [] if path.is_symlink() else [str(path)]
    for folder in found:  # which grows
        with contextlib.suppress(OSError):
            os.chmod(folder, 0o700)
            with os.scandir(folder) as items:
                found += [item.path for item in items if item.is_dir(follow_symlinks=False)]
    for folder in reversed(found):
        with contextlib.suppress(OSError):
            for name in os.listdir(folder):
                with contextlib.suppress(OSError):
                    file = os.path.join(folder, name)
                    if IS_WINDOWS:  # which removes no file that cannot be written
                        os.chmod(file, folders.PRIVATE_MODE)
                    os.unlink(file)
            os.rmdir(folder)


def recall(folder: Path, key: str) -> str | None:
    """A text that ``keep`` wrote; None if it is not there, or others could have written it."""
    path = folder / key
    try:
        if not folders.is_ours_alone(folder) or path.stat().st_size > _MAX_TEXT_BYTES:
            return None
        return path.read_text("utf-8")
    except (OSError, ValueError):
        return None


def keep(folder: Path, key: str, text: str) -> None:
    """Remember a text. A cache that cannot be written is no error."""
    with contextlib.suppress(OSError):
        folders.make_private(folder)
        write_whole_file(folder / key, text.encode())
