"""A folder of a stranger's source files: written file by file, within bounds, without links.

Source distributions and commits of git both come as ``Member``s, which ``write_tree`` writes.
"""

from __future__ import annotations

import bz2
import gzip
import io
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any

from envhub_sandbox.errors import PackageIntegrityError, PackagesTooLargeError, SnapshotError
from envhub_sandbox.hub.listing import FileRecord, check_listing_names, copy_bounded
from envhub_sandbox.system import folders
from envhub_worker.protocol.text import size_text

MAX_BYTES = 2 * 2**30
"""Of all files of one source, unpacked."""
MAX_FILES = 50_000
AT_ONCE = 2**20
"""The most that is read at once: an extended header says its own length."""
MAX_TABLE = 16 * 2**20
"""Of a zip's table of contents."""
_HEADERS = 1000
_PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""How members of a zip may be packed: Python unpacks other ways whole, whatever it is asked for."""
_FAR = 2 * MAX_BYTES
_BROKEN = (OSError, EOFError, ValueError, zlib.error, tarfile.TarError, zipfile.BadZipFile)
_BROKEN_ZIP = (RuntimeError, NotImplementedError)  # it is encrypted, or compressed in another way

_TARS: dict[str, Callable[..., Any]] = {".gz": gzip.open, ".tgz": gzip.open, ".bz2": bz2.open}


@dataclass(frozen=True)
class Member:
    """A regular file that is to be written; ``open`` gives a stream of its bytes."""

    path: str
    size: int
    executable: bool
    open: Callable[[], IO[bytes]]


def write_tree(members: Iterable[Member], folder: Path, title: str) -> None:
    """Write files below a folder that is there and empty; within bounds, under names that stay in
    it.
    """
    kept = list(_bounded(members, title))
    try:
        check_listing_names([FileRecord(one.path, one.size, "") for one in kept], title)
    except SnapshotError as error:
        raise PackageIntegrityError(str(error)) from error
    for member in kept:
        path = folder / member.path
        folders.make(path.parent)
        with member.open() as source, path.open("xb") as target:
            if copy_bounded(source, target, member.size) != member.size:
                raise PackageIntegrityError(
                    f"{title}: {member.path!r} has not the size that it says"
                )
        path.chmod(0o755 if member.executable else 0o644)


def _bounded(members: Iterable[Member], title: str) -> Iterator[Member]:
    size = 0
    for count, member in enumerate(members, start=1):
        size += member.size
        if size > MAX_BYTES or count > MAX_FILES:
            raise PackagesTooLargeError(
                f"{title} has more than {size_text(MAX_BYTES)} or {MAX_FILES} files; it is not "
                "unpacked"
            )
        yield member


def unpack_tree(archive: Path, folder: Path, title: str) -> Path:
    """Unpack a source distribution below a folder, as ``write_tree``; gives its one top folder."""
    try:
        with _members(archive, title) as members:
            write_tree(members, folder, title)
    except (*_BROKEN, *_BROKEN_ZIP) as error:
        raise PackageIntegrityError(f"{title} cannot be unpacked: {error}") from error
    tops = list(folder.iterdir())
    if len(tops) != 1 or not tops[0].is_dir():
        raise PackageIntegrityError(
            f"{title} is not a source distribution, which has a single folder: this has "
            f"{len(tops)} entries"
        )
    return tops[0]


@contextmanager
def _members(archive: Path, title: str) -> Iterator[Iterator[Member]]:
    with ExitStack() as stack:
        if archive.suffix == ".zip":
            stream: Any = BoundedStream(stack.enter_context(archive.open("rb")), title, MAX_TABLE)
            yield _of_zip(stack.enter_context(zipfile.ZipFile(stream)), title)
        elif opener := _TARS.get(archive.suffix):
            stream = BoundedStream(stack.enter_context(opener(archive, "rb")), title)
            yield _of_tar(stack.enter_context(tarfile.open(fileobj=stream, mode="r:")), title)
        else:
            raise PackageIntegrityError(
                f"{title} is packed as {archive.suffix!r}; .tar.gz, .tar.bz2 and .zip are read"
            )


class BoundedStream(io.RawIOBase):
    """A stream that refuses to be read far, or much at once: an archive says its own lengths."""

    def __init__(self, stream: IO[bytes], title: str, at_once: int = AT_ONCE) -> None:
        self._stream = stream
        self._title = title
        self._at_once = at_once

    def read(self, size: int = -1) -> bytes:
        """At most so many bytes; all that are left are few, too."""
        self._check(0 if size < 0 else size, self._at_once)
        self._check(self._stream.tell(), _FAR)
        found = self._stream.read(self._at_once + 1 if size < 0 else size)
        self._check(len(found), self._at_once)
        return found

    def seek(self, offset: int, whence: int = 0) -> int:
        """As of every stream; one that is compressed is read up to there."""
        self._check(offset, _FAR)
        return self._stream.seek(offset, whence)

    def tell(self) -> int:
        """Where it is."""
        return self._stream.tell()

    def seekable(self) -> bool:
        """Always."""
        return True

    def _check(self, count: int, most: int) -> None:
        if count > most:
            raise PackagesTooLargeError(f"{self._title} is too large to be unpacked")


def _of_tar(archive: tarfile.TarFile, title: str) -> Iterator[Member]:
    for count, member in enumerate(archive):
        if count > 2 * MAX_FILES:
            raise PackagesTooLargeError(f"{title} has more than {MAX_FILES} files")
        if len(archive.pax_headers) > _HEADERS:
            raise PackagesTooLargeError(f"{title} has more than {_HEADERS} headers for all files")
        # each has a copy of all headers: what is kept must not
        archive.members.clear()  # type: ignore[attr-defined]  # not in the stubs
        member.pax_headers = {}
        if member.isdir():
            continue
        if not member.isreg():
            raise _no_file(title, member.name)
        path, opened = member.name.removeprefix("./"), partial(_opened, archive, member)
        yield Member(path, member.size, bool(member.mode & stat.S_IXUSR), opened)


def _opened(archive: tarfile.TarFile, member: tarfile.TarInfo) -> IO[bytes]:
    stream = archive.extractfile(member)
    assert stream is not None
    return stream


def check_zip_member(member: zipfile.ZipInfo, title: str) -> None:
    """Refuse what is neither file nor folder, and what Python unpacks whole."""
    kinds = (0, stat.S_IFREG, *([stat.S_IFDIR] if member.is_dir() else []))
    if stat.S_IFMT(member.external_attr >> 16) not in kinds:
        raise _no_file(title, member.filename)
    if member.compress_type not in _PACKINGS:
        raise PackageIntegrityError(
            f"{title} holds {member.filename[:200]!r}, packed in another way, which is not read"
        )


def _of_zip(archive: zipfile.ZipFile, title: str) -> Iterator[Member]:
    for member in archive.infolist():
        mode = member.external_attr >> 16
        if member.is_dir():
            continue
        check_zip_member(member, title)
        opened = partial(archive.open, member)
        yield Member(member.filename, member.file_size, bool(mode & stat.S_IXUSR), opened)


def _no_file(title: str, name: str) -> PackageIntegrityError:
    return PackageIntegrityError(
        f"{title} holds {name[:200]!r}, which is a link or a device; only files are unpacked"
    )
