"""Writes a stranger's source files to a folder: file by file, within bounds, without links.

Source distributions and git commits both come as ``Member``s, which ``write_tree`` writes.

Our own reader reads a tar once, forwards: Python's follows the headers, also backwards where a size
is negative, and unpacks a file from its start for each step back.
"""

from __future__ import annotations

import bz2
import gzip
import io
import itertools
import re
import stat
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import IO, Any

from envhub_sandbox.errors import DependencyError, SnapshotError
from envhub_sandbox.hub.listing import FileRecord, check_listing_names, copy_bounded
from envhub_sandbox.system import folders
from envhub_worker.protocol.text import size_text

MAX_BYTES = 2 * 2**30
"""Bytes of all unpacked files of one source."""
MAX_FILES = 50_000
AT_ONCE = 2**20
"""The most bytes of one read: an extended header states its own length."""
MAX_TABLE = 16 * 2**20
"""Bytes of a zip's table of contents."""
_PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compression methods of a zip: Python unpacks members of other methods whole, at any read."""
_LEAST_HEADER = 30
"""Bytes in a zip before each member."""
_FAR = 2 * MAX_BYTES
_BROKEN = (OSError, EOFError, ValueError, zlib.error, tarfile.TarError, zipfile.BadZipFile)
_BROKEN_ZIP = (RuntimeError, NotImplementedError)  # encrypted, or compressed by another method

_TARS: dict[str, Callable[..., Any]] = {".gz": gzip.open, ".tgz": gzip.open, ".bz2": bz2.open}


@dataclass(frozen=True)
class Member:
    """A regular file to write; ``open`` returns a stream of its bytes, which the caller may have to
    read before it takes the next member.
    """

    path: str
    size: int
    executable: bool
    open: Callable[[], IO[bytes]]


def write_tree(members: Iterable[Member], folder: Path, title: str) -> None:
    """Write files into an existing, empty folder, within bounds and under names that stay in it.
    Until all names are known, the files lie beside the folder under numbers.
    """
    with tempfile.TemporaryDirectory(prefix="unpacked-", dir=folder.parent) as numbered:
        kept = []
        for number, member in enumerate(_bounded(members, title)):
            _write(member, Path(numbered, str(number)), title)
            kept.append(member.path)
        try:
            check_listing_names([FileRecord(path, 0, "") for path in kept], title)
        except SnapshotError as error:
            raise not_as_expected(str(error)) from error
        for number, path in enumerate(kept):
            folders.make((folder / path).parent)
            Path(numbered, str(number)).rename(folder / path)


def _write(member: Member, path: Path, title: str) -> None:
    with member.open() as source, path.open("xb") as target:
        if copy_bounded(source, target, member.size) != member.size:
            raise not_as_expected(f"{title}: {member.path!r} has another size than its header says")
    path.chmod(0o755 if member.executable else 0o644)


def _bounded(members: Iterable[Member], title: str) -> Iterator[Member]:
    size = 0
    for count, member in enumerate(members, start=1):
        size += member.size
        if size > MAX_BYTES or count > MAX_FILES:
            raise DependencyError(
                f"{title} has more than {size_text(MAX_BYTES)} or {MAX_FILES} files; it is not "
                "unpacked",
                reason="size",
            )
        yield member


def unpack_tree(archive: Path, folder: Path, title: str) -> Path:
    """Unpacks a source distribution like ``write_tree``; returns its one top folder."""
    try:
        with _members(archive, title) as members:
            write_tree(members, folder, title)
    except (*_BROKEN, *_BROKEN_ZIP) as error:
        raise not_as_expected(f"{title} cannot be unpacked: {error}") from error
    tops = list(folder.iterdir())
    if len(tops) != 1 or not tops[0].is_dir():
        raise not_as_expected(
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
            yield _of_tar(_ForwardStream(stack.enter_context(opener(archive, "rb")), title), title)
        else:
            raise not_as_expected(
                f"{title} is packed as {archive.suffix!r}; .tar.gz, .tar.bz2 and .zip are read"
            )


class BoundedStream(io.RawIOBase):
    """A file with bounds on the position and on one read: an archive states its own lengths."""

    def __init__(self, stream: IO[bytes], title: str, at_once: int = AT_ONCE) -> None:
        self._stream = stream
        self._title = title
        self._at_once = at_once

    def read(self, size: int = -1) -> bytes:
        """Reads at most ``size`` bytes; a read of the whole rest is bounded too."""
        self._check(0 if size < 0 else size, self._at_once)
        self._check(self._stream.tell(), _FAR)
        data = self._stream.read(self._at_once + 1 if size < 0 else size)
        self._check(len(data), self._at_once)
        return data

    def seek(self, offset: int, whence: int = 0) -> int:
        """Seek like any file, within the bound."""
        self._check(offset, _FAR)
        return self._stream.seek(offset, whence)

    def tell(self) -> int:
        """Returns the position."""
        return self._stream.tell()

    def seekable(self) -> bool:
        """Always true."""
        return True

    def _check(self, count: int, most: int) -> None:
        if count > most:
            raise DependencyError(f"{self._title} is too large to be unpacked", reason="size")


class _ForwardStream:
    """A stream that is read once and forwards, up to a bound.
    ``at``: the number of bytes read so far.
    """

    def __init__(self, stream: IO[bytes], title: str) -> None:
        self._stream = stream
        self._title = title
        self.at = 0

    def take(self, size: int, *, may_end: bool = False) -> bytes:
        """Returns the next ``size`` bytes; none at the end, if the stream may end here."""
        if size > AT_ONCE or self.at + size > _FAR:
            raise DependencyError(f"{self._title} is too large to be unpacked", reason="size")
        data = self._stream.read(size)
        if len(data) != size and (data or not may_end):
            raise not_as_expected(f"{self._title} cannot be unpacked: its end is missing")
        self.at += len(data)
        return data

    def part(self, size: int, start: int) -> IO[bytes]:
        """Returns a stream of the next ``size`` bytes; valid until this stream moves on."""
        assert self.at == start, "members are read in their order"
        return io.BufferedReader(_Part(self, size))


class _Part(io.RawIOBase):
    """The next ``size`` bytes of a stream."""

    def __init__(self, stream: _ForwardStream, size: int) -> None:
        self._stream = stream
        self._left = size

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        data = self._stream.take(min(len(buffer), self._left, AT_ONCE))
        buffer[: len(data)] = data
        self._left -= len(data)
        return len(data)


_TAR_BLOCK = 512
_REGULAR = (tarfile.REGTYPE, tarfile.AREGTYPE, tarfile.CONTTYPE)
_PAX = (tarfile.XHDTYPE, tarfile.SOLARIS_XHDTYPE, tarfile.XGLTYPE)
_LONG = {tarfile.GNUTYPE_LONGNAME: "path", tarfile.GNUTYPE_LONGLINK: "linkpath"}
_RECORD = re.compile(rb"(\d{1,7}) ([^=]+)=")


def _of_tar(stream: _ForwardStream, title: str) -> Iterator[Member]:
    said: dict[str, str] = {}
    for count in itertools.count():
        if count > 4 * MAX_FILES:  # an entry has up to two headers, and a file may have a folder
            raise DependencyError(f"{title} has more than {MAX_FILES} files", reason="size")
        block = stream.take(_TAR_BLOCK, may_end=count > 0)
        if not block.strip(b"\0"):
            return
        header = tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
        size = _size_of(header, said, title)
        start, end = stream.at, stream.at - -size // _TAR_BLOCK * _TAR_BLOCK
        if header.type in (*_PAX, *_LONG):
            said |= _said(header.type, stream.take(size), title)
        elif header.type in _REGULAR:
            path = said.get("path", header.name).removeprefix("./")
            opened = partial(stream.part, size, start)
            yield Member(path, size, bool(header.mode & stat.S_IXUSR), opened)
            said = {}
        elif header.type == tarfile.DIRTYPE:
            said, end = {}, start  # no data follows the header of a folder
        else:
            raise _no_file(title, said.get("path", header.name))
        while stream.at < end:
            stream.take(min(AT_ONCE, end - stream.at))


def _size_of(header: tarfile.TarInfo, said: dict[str, str], title: str) -> int:
    """Returns the size of a header's data; a preceding extended header overrides a file's size."""
    size = said.get("size", "") if header.type in _REGULAR else ""
    if header.size < 0 or not re.fullmatch(r"[0-9]{0,20}", size):
        raise not_as_expected(f"{title} holds {header.name[:200]!r}, whose size is invalid")
    return int(size or header.size)


def _said(kind: bytes, data: bytes, title: str) -> dict[str, str]:
    """Returns an extended header's fields for the next header; a global one must not set them."""
    if kind in _LONG:
        name = data.partition(b"\0")[0].decode("utf-8", "surrogateescape")
        return {_LONG[kind]: name}
    fields, at = {}, 0
    while record := _RECORD.match(data, at):
        end = at + int(record[1])
        if not record.end() < end <= len(data):
            break
        name = record[2].decode("utf-8", "replace")
        if name.startswith("GNU.sparse") or (kind == tarfile.XGLTYPE and name in ("path", "size")):
            raise not_as_expected(f"{title} is packed with {name}, which is not read")
        if name in ("path", "size"):
            fields[name] = data[record.end() : end - 1].decode("utf-8", "surrogateescape")
        at = end
    if data[at:].strip(b"\0"):
        raise not_as_expected(f"{title} cannot be unpacked: it has a malformed header")
    return fields


def check_zip(members: Sequence[zipfile.ZipInfo], title: str) -> None:
    """Refuse special files, members that Python unpacks whole, and members that overlap."""
    end = 0
    for member in sorted(members, key=attrgetter("header_offset")):
        kinds = (0, stat.S_IFREG, *([stat.S_IFDIR] if member.is_dir() else []))
        if stat.S_IFMT(member.external_attr >> 16) not in kinds:
            raise _no_file(title, member.filename)
        if member.compress_type not in _PACKINGS:
            raise not_as_expected(
                f"{title} holds {member.filename[:200]!r}, packed by a method that is not supported"
            )
        if member.header_offset < end:
            raise not_as_expected(
                f"{title} holds {member.filename[:200]!r}, which lies within another file"
            )
        end = member.header_offset + _LEAST_HEADER + member.compress_size


def _of_zip(archive: zipfile.ZipFile, title: str) -> Iterator[Member]:
    members = archive.infolist()
    check_zip(members, title)
    for member in members:
        mode = member.external_attr >> 16
        if not member.is_dir():
            opened = partial(archive.open, member)
            yield Member(member.filename, member.file_size, bool(mode & stat.S_IXUSR), opened)


def not_as_expected(text: str) -> DependencyError:
    """Builds the error for a package that contradicts its hashes or its index."""
    return DependencyError(text, reason="integrity")


def _no_file(title: str, name: str) -> DependencyError:
    return not_as_expected(
        f"{title} holds {name[:200]!r}, which is a link or a device; only files are unpacked"
    )
