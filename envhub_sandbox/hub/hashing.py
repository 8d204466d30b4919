"""Digests as the Hub's listings give them, and copies that are hashed while they are written."""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from envhub_sandbox.hub.listing import FileRecord

_CHUNK_BYTES = 1 << 20
GIT_SHA1 = "git-sha1"
SHA256 = "sha256"


class HashMismatch(Exception):
    """Bytes are not the ones that were recorded; ``found`` says in words what they are."""

    def __init__(self, found: str) -> None:
        super().__init__(found)
        self.found = found


def _start(kind: str, size: int) -> Any:
    if kind == SHA256:
        return hashlib.sha256()
    # A git blob id covers the length too; git chose SHA-1, we only follow.
    sha1 = hashlib.sha1(usedforsecurity=False)
    sha1.update(b"blob %d\x00" % size)
    return sha1


def digest_of(source: Path, kind: str, size: int) -> str:
    """The digest of a file that should have ``size`` bytes, for example ``"sha256:..."``."""
    running = _start(kind, size)
    with _open_regular(source) as stream:
        for chunk in _chunks(stream):
            running.update(chunk)
    return f"{kind}:{running.hexdigest()}"


def copy_verified(source: Path, target: Path, record: FileRecord) -> None:
    """Copy a file into a new one; as ``write_verified``."""
    with _open_regular(source) as stream:
        write_verified(stream, target, record)


def write_verified(stream: IO[bytes], target: Path, record: FileRecord) -> None:
    """Write a new file; what was written is exactly what the record says.

    The hash is taken of the bytes on their way, so they cannot change in between.

    Raises:
        HashMismatch: Other bytes or another size. The new file may be there in part.
    """
    running = _start(record.digest.partition(":")[0], record.size)
    written = 0
    with target.open("xb") as out:
        for chunk in _chunks(stream):
            written += len(chunk)
            if written > record.size:
                raise HashMismatch(f"more than {record.size} bytes")
            running.update(chunk)
            out.write(chunk)
    found = f"{record.digest.partition(':')[0]}:{running.hexdigest()}"
    if written != record.size or found != record.digest:
        raise HashMismatch(f"{written} bytes with {found}")


def differing(root: Path, mine: Iterable[FileRecord], theirs: Iterable[FileRecord]) -> list[str]:
    """The files below ``root`` that another listing has with other bytes, or not at all."""
    listed = {record.path: record for record in theirs}
    return [
        file.path
        for file in mine
        if (there := listed.get(file.path)) is None
        or there.size != file.size
        or digest_of(root / file.path, there.digest.partition(":")[0], file.size) != there.digest
    ]


@contextmanager
def _open_regular(path: Path) -> Iterator[IO[bytes]]:
    try:
        # A pipe or device under the name would block or never end.
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise HashMismatch("not a regular file")
        stream = path.open("rb")
    except OSError as error:
        raise HashMismatch(f"unreadable ({error})") from error
    with stream:
        yield stream


def _chunks(stream: IO[bytes]) -> Iterator[bytes]:
    while chunk := stream.read(_CHUNK_BYTES):
        yield chunk
