"""The folders that ``envhub`` needs: one for temporary files, and the cache."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from envhub_sandbox.errors import SandboxUnavailableError, SnapshotError


@contextlib.contextmanager
def scratch_folder() -> Iterator[Path]:
    """A folder for a repository and a cache: what is wrong with the caller's hides no layer.

    Raises:
        SandboxUnavailableError: There is no place for one.
    """
    from envhub_sandbox.hub.store import CACHE_VARIABLE

    try:
        made = tempfile.TemporaryDirectory(prefix="envhub-doctor-")
    except OSError as error:
        raise SandboxUnavailableError(
            f"there is no folder for temporary files that can be written ({error.strerror}); set "
            "TMPDIR to one, or start a read-only container with --tmpfs /tmp"
        ) from error
    before = os.environ.get(CACHE_VARIABLE)
    with made as folder:
        os.chmod(folder, 0o755)  # jails of another user read it
        os.environ[CACHE_VARIABLE] = f"{folder}/cache"
        try:
            yield Path(folder)
        finally:
            os.environ.pop(CACHE_VARIABLE)
            if before is not None:
                os.environ[CACHE_VARIABLE] = before


def cache_problem(*, by_others: bool) -> str | None:
    """Why the caller's cache is of no use, and what to do; None if it is.

    Args:
        by_others: Whether root's jails read it as another user: all but those with a private root.
    """
    from envhub_sandbox.hub.store import cache_root

    try:
        root = cache_root()
    except SnapshotError as error:
        return str(error)
    there = next(path for path in (root, *root.parents) if path.exists())
    cure = f"set ENVHUB_CACHE to another folder, such as {tempfile.gettempdir()}/envhub-cache"
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        return f"{root} cannot be written: {cure}"
    closed = [path for path in (there, *there.parents) if not path.stat().st_mode & 0o001]
    if os.geteuid() == 0 and by_others and closed:
        return (
            f"{root} cannot be read by the user of root's jails, since {closed[-1]} is closed to "
            f"others: {cure}"
        )
    return None
