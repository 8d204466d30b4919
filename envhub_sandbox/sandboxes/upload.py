"""A snapshot's files on their way to a server on another host: by hash, and only missing ones."""

from __future__ import annotations

import hashlib
import os
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from envhub_sandbox.errors import SnapshotError, WorkerError
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.replies import expect_reply
from envhub_worker.protocol import messages as m

PIECE_BYTES = 256 * 1024
"""Small enough that a heartbeat does not wait long behind it."""
_WINDOW = 8
"""Pieces under way: together with the size, what fills a line of some 40 MB/s over 50 ms."""


class Sent(NamedTuple):
    """One file of a listing."""

    path: str
    size: int
    sha256: bytes


def listing(root: Path) -> tuple[Sent, ...]:
    """Every file below a snapshot's root, hashed. Raises ``SnapshotError``."""
    try:
        return tuple(_sent(root, path) for path in sorted(_files(root)))
    except OSError as error:
        raise SnapshotError(f"the snapshot in {root} cannot be read: {error}") from error


def _files(root: Path) -> Iterator[Path]:
    for folder, _, names in os.walk(root):
        yield from (Path(folder, name) for name in names)


def _sent(root: Path, path: Path) -> Sent:
    running, size = hashlib.sha256(), 0
    with path.open("rb") as file:
        while piece := file.read(PIECE_BYTES):
            running.update(piece)
            size += len(piece)
    return Sent(path.relative_to(root).as_posix(), size, running.digest())


def upload(
    client: WorkerConnection, root: Path, files: tuple[Sent, ...], deadline: Deadline
) -> tuple[str, int]:
    """Bring files to a server.

    Returns:
        What the server calls the snapshot, and how many bytes had to travel.

    Raises:
        SnapshotIntegrityError: A file arrived as another than it left.
        WorkerError: The server does not take them, or took too long.
    """
    wanted = _offer(client, files, deadline)
    by_hash = {file.sha256: file for file in files}
    missing = [by_hash[sha] for sha in wanted.hashes if isinstance(sha, bytes) and sha in by_hash]
    if not wanted.hashes:
        return wanted.snapshot, 0
    _put(client, root, missing, deadline)
    wanted = _offer(client, files, deadline)
    if wanted.hashes:
        raise WorkerError("the server has taken the snapshot's files and still wants some")
    return wanted.snapshot, sum(file.size for file in missing)


def _offer(client: WorkerConnection, files: tuple[Sent, ...], deadline: Deadline) -> m.MissingBlobs:
    offer = m.OfferSnapshot(tuple(tuple(file) for file in files))
    reply, _ = client.request(offer, deadline=deadline)
    return expect_reply(reply, m.MissingBlobs)


def _put(client: WorkerConnection, root: Path, missing: list[Sent], deadline: Deadline) -> None:
    """Send piece after piece, with some under way; the server answers in order."""
    under_way: deque[int] = deque()
    for sha256, offset, piece in _pieces(root, missing):
        if len(under_way) >= _WINDOW:
            expect_reply(client.receive(under_way.popleft(), deadline)[0], m.Done)
        under_way.append(client.send(m.PutBlob(sha256, offset), [piece]))
    while under_way:
        expect_reply(client.receive(under_way.popleft(), deadline)[0], m.Done)


def _pieces(root: Path, missing: list[Sent]) -> Iterator[tuple[bytes, int, bytes]]:
    for sent in missing:
        with (root / sent.path).open("rb") as file:
            offset = 0
            while True:
                piece = file.read(PIECE_BYTES)
                if piece or not sent.size:
                    yield sent.sha256, offset, piece
                offset += len(piece)
                if offset >= sent.size or not piece:
                    break
