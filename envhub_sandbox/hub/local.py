"""A folder of this machine as the files of a snapshot, so that authors can try before they push.

Left out, as ``git`` and the Hub would: version control, caches, virtual environments, sockets
and pipes. Links that stay inside the folder are copied as what they point to; a link that leaves
it is refused, since the jail must see nothing but the folder.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from envhub_sandbox.errors import RepositoryUnavailableError, SnapshotError
from envhub_sandbox.hub.hashing import SHA256, Mismatch, copy_verified, digest_of
from envhub_sandbox.hub.listing import MAX_DEPTH, FileRecord

LEFT_OUT = frozenset(
    {
        *(".git", ".hg", ".svn", ".DS_Store", ".ipynb_checkpoints", ".cache", "__pycache__"),
        *(".mypy_cache", ".pytest_cache", ".ruff_cache", ".tox", ".venv", "node_modules"),
    }
)
_LEFT_OUT_SUFFIXES = (".pyc", ".pyo")


class LocalFile(NamedTuple):
    """A file to copy: its name in the snapshot, and where its bytes are."""

    path: str
    source: Path
    size: int


def split_local(text: str, path: str) -> tuple[Path, str]:
    """The folder and entry of ``./env``, ``./env:sub/env.py`` or ``./env/other.py``.

    Raises:
        RepositoryUnavailableError: There is no such folder, or the file is not Python's.
    """
    folder = Path(os.path.abspath(os.path.expanduser(text)))
    if folder.is_dir():
        return folder, os.path.normpath(path)
    if folder.is_file():
        if folder.suffix != ".py":
            raise RepositoryUnavailableError(
                f"local file {text!r}: an entry is a .py file, or a folder with an env.py"
            )
        return folder.parent, folder.name
    before, colon, after = text.rpartition(":")
    if colon and before and after:
        inner = Path(os.path.abspath(os.path.expanduser(before)))
        if inner.is_dir():
            return inner, os.path.normpath(after)
    raise RepositoryUnavailableError(
        f"local folder {text!r}: there is no such folder or file here (looked for {folder}). "
        "Write './folder', './folder:path/env.py' or './folder/env.py'; a repository of the Hub "
        "is owner/name"
    )


def scan(folder: Path) -> Iterator[LocalFile]:
    """Yield the files below a folder, links resolved. Names are relative, with ``/``.

    Raises:
        SnapshotError: A link leaves the folder, is broken or leads to a loop.
    """
    real = Path(os.path.realpath(folder))
    yield from _scan(real, real, "", (real,))


def _scan(root: Path, folder: Path, prefix: str, above: tuple[Path, ...]) -> Iterator[LocalFile]:
    if len(above) > MAX_DEPTH:
        raise SnapshotError(f"local folder {root}: {prefix!r} is over {MAX_DEPTH} folders deep")
    with os.scandir(folder) as listing:
        items = sorted(listing, key=lambda item: item.name)
    for item in items:
        name = prefix + item.name
        if item.name in LEFT_OUT or item.name.endswith(_LEFT_OUT_SUFFIXES):
            continue
        source = _inside(root, item, name)
        if source.is_dir():
            if source in above:
                raise SnapshotError(f"local folder {root}: the link {name!r} leads to a loop")
            if not (source / "pyvenv.cfg").exists():
                yield from _scan(root, source, f"{name}/", (*above, source))
        elif source.is_file():
            yield LocalFile(name, source, source.stat().st_size)


def _inside(root: Path, item: os.DirEntry[str], name: str) -> Path:
    if not item.is_symlink():
        return Path(item.path)
    try:
        source = Path(os.path.realpath(item.path, strict=True))
    except OSError as error:
        raise SnapshotError(
            f"local folder {root}: the link {name!r} leads nowhere; remove it"
        ) from error
    if root != source and root not in source.parents:
        raise SnapshotError(
            f"local folder {root}: the link {name!r} leaves the folder (to {source}), and a "
            "sandbox sees nothing else of this machine; put a copy in its place"
        )
    return source


def hash_files(files: tuple[LocalFile, ...], title: str) -> tuple[FileRecord, ...]:
    """The records of files, by reading all of them."""
    return tuple(FileRecord(file.path, file.size, _digest(file, title)) for file in files)


def _digest(file: LocalFile, title: str) -> str:
    try:
        return digest_of(file.source, SHA256, file.size)
    except (OSError, Mismatch) as error:
        raise SnapshotError(f"{title}: {file.path!r} cannot be read: {error}") from error


def content_commit(files: tuple[FileRecord, ...]) -> str:
    """``"local-"`` and a hash of names and contents: the same content is the same commit."""
    rows = [[file.path, file.size, file.digest] for file in files]
    return "local-" + hashlib.sha256(json.dumps(rows).encode()).hexdigest()


def copier(files: tuple[LocalFile, ...], title: str) -> Callable[[FileRecord, Path], None]:
    """A function that copies one file into the store, or says that it changed meanwhile."""
    sources = {file.path: file.source for file in files}

    def copy(record: FileRecord, target: Path) -> None:
        try:
            copy_verified(sources[record.path], target, record)
        except Mismatch as error:
            raise SnapshotError(
                f"{title}: {record.path!r} changed while it was copied; try again"
            ) from error

    return copy
