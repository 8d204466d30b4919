"""One repository on another host: uploads its files, and has the server make its packages.

The client uploads a snapshot's files by hash, and only those that the server lacks. The server's
operator decides whether packages are installed there. Client and server both read the declared
requirements. The server keeps the packages that it makes; no file of them comes to the client.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import stat
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from envhub_sandbox.errors import (
    DependencyError,
    PolicyError,
    RemoteProtocolError,
    SnapshotError,
    WorkerError,
)
from envhub_sandbox.extras.packages.packages import PackageSet
from envhub_sandbox.extras.packages.request import PackageRequest
from envhub_sandbox.hub.store import programs_of
from envhub_sandbox.sandboxes.pool import ServerUse, WorkerServer
from envhub_sandbox.sandboxes.sandbox import Sandbox
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.replies import expect_reply
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.text import printable

if TYPE_CHECKING:
    from envhub_sandbox.extras.packages.declared import WantedPackage

PIECE_BYTES = 256 * 1024
"""The size of a piece of an upload: small enough that a heartbeat waits only briefly behind it."""
_WINDOW = 8
"""Unanswered pieces: 8 pieces fill a connection of about 40 MB/s with a latency of 50 ms."""


class Sent(NamedTuple):
    """A file of a snapshot."""

    path: str
    size: int
    sha256: bytes
    executable: bool

    @property
    def row(self) -> tuple[object, ...]:
        """The row of ``OfferSnapshot`` for this file."""
        return tuple(self) if self.executable else tuple(self)[:-1]


def listing(root: Path) -> tuple[Sent, ...]:
    """Hash every file below a snapshot's root. Raises ``SnapshotError``: one cannot be read."""
    try:
        programs = programs_of(root)
        return tuple(_sent(root, path, programs) for path in sorted(_files(root)))
    except OSError as error:
        raise SnapshotError(f"the snapshot in {root} cannot be read: {error}") from error


def _files(root: Path) -> Iterator[Path]:
    for folder, _, names in os.walk(root):
        yield from (Path(folder, name) for name in names)


def _sent(root: Path, path: Path, programs: frozenset[str] | None) -> Sent:
    name, running, size = path.relative_to(root).as_posix(), hashlib.sha256(), 0
    with path.open("rb") as file:
        while piece := file.read(PIECE_BYTES):
            running.update(piece)
            size += len(piece)
        executable = bool(os.fstat(file.fileno()).st_mode & stat.S_IXUSR)
    if programs is not None:
        executable = name in programs
    return Sent(name, size, running.digest(), executable)


def upload(
    client: WorkerConnection, root: Path, files: tuple[Sent, ...], deadline: Deadline
) -> tuple[str, int]:
    """Upload files. Returns the server's name for the snapshot, and the number of uploaded bytes.
    Raises ``SnapshotIntegrityError``: a file arrived with another hash; ``WorkerError``: the server
    rejects the files, or takes too long.
    """
    wanted = _offer(client, files, deadline)
    by_hash = {file.sha256: file for file in files}
    wanted_hashes = {sha for sha in wanted.hashes if isinstance(sha, bytes)}  # a hash counts once
    missing = [file for sha, file in by_hash.items() if sha in wanted_hashes]
    if not wanted.hashes:
        return wanted.snapshot, 0
    _put(client, root, missing, deadline)
    wanted = _offer(client, files, deadline)
    if wanted.hashes:
        raise WorkerError("the server has all files of the snapshot, and still asks for some")
    return wanted.snapshot, sum(file.size for file in missing)


def _offer(client: WorkerConnection, files: tuple[Sent, ...], deadline: Deadline) -> m.MissingBlobs:
    offer = m.OfferSnapshot(tuple(file.row for file in files))
    reply, _ = client.request(offer, deadline=deadline)
    return expect_reply(reply, m.MissingBlobs)


def _put(client: WorkerConnection, root: Path, missing: list[Sent], deadline: Deadline) -> None:
    """Send the pieces, at most ``_WINDOW`` of them unanswered; the server answers in order."""
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


_HELLO_S = 30.0
_MAKE_S = 2 * 3600.0
_POLL_S = 0.5
_NAME_CHARS = 64
_FACTS = ("lock", "packages")
_MAX_PINS = 10_000
_MAX_CHARS = 300


@dataclass(frozen=True)
class ServerPackages:
    """The packages that a server makes itself: a ``PackageTarget``.
    ``use``: acquires the server.
    ``orders``: the request for each set of packages, by the server's name for the set. ``make``
    adds to it.
    """

    use: Callable[[], ServerUse[WorkerServer]]
    orders: dict[str, m.NeedPackages]

    def meets(self, request: PackageRequest) -> bool:
        """False, because only the server knows its packages; it compares them in ``make``."""
        return False

    def make(self, request: PackageRequest, tell: Callable[[str], None]) -> PackageSet | None:
        """Have the server make the packages; None if its own are enough.
        Raises as ``request_packages``.
        """
        order = order_of(request)
        use = self.use()
        server = use.server
        try:
            client = WorkerConnection(server.endpoint, server.process_fd, far=server.far)
            with contextlib.closing(client):
                client.hello(Deadline(_HELLO_S))
                packages = request_packages(order, client, Deadline(_MAKE_S), tell)
        finally:
            use.release()
        if packages is not None:
            self.orders[packages.packages] = order
        return packages


def order_of(request: PackageRequest) -> m.NeedPackages:
    """Make the message for the server. Raises ``PolicyError``: it names a path of this machine."""
    if os.sep in request.python:
        raise PolicyError(
            f"python in dependencies is {request.python!r}, an interpreter of this machine, and a "
            "remote server has its own: name a version, such as '3.12'"
        )
    if request.fetch_python:
        raise PolicyError(
            "fetch_python in dependencies is for this machine; a server's operator installs its "
            "interpreters"
        )
    return m.NeedPackages(
        _rows(request.wanted),
        request.supports,
        request.python,
        request.exclude_newer or "",
        request.always,
        guesses=tuple(
            (str(guess.wanted), guess.wanted.where, guess.module, " ".join(guess.brought_by))
            for guess in request.guesses
        ),
        constraints=_rows(request.constraints),
        override=_rows(request.override),
        without=request.without,
        gpu=request.gpu,
    )


def _rows(wanted: Sequence[WantedPackage]) -> tuple[tuple[str, str], ...]:
    return tuple((str(package), package.where) for package in wanted)


def request_packages(
    order: m.NeedPackages,
    client: WorkerConnection,
    deadline: Deadline,
    tell: Callable[[str], None] = lambda line: None,
) -> PackageSet | None:
    """Have the server make packages, and wait for them; None if its own are enough.
    Raises ``DependencyError``: they cannot be made; the text says what to change; ``PolicyError``:
    the server's operator does not permit it; ``ServerBusyError``: another client with the same key
    is making packages; ``WorkerTimeoutError``: the server takes too long.
    """
    shown = ""
    while True:
        reply, _ = client.request(order, deadline=deadline)
        answer = expect_reply(reply, m.Packages)
        if answer.state == "own":
            return None
        if answer.state == "made":
            # Trust: only the server interprets the name.
            if not 0 < len(answer.name) <= _NAME_CHARS or not answer.name.isalnum():
                raise RemoteProtocolError("the server gives the packages an invalid name")
            return PackageSet(answer.name, _facts(answer.facts, order))
        if answer.state != "making":
            raise RemoteProtocolError("the server reports an unknown state of packages")
        line = printable(answer.progress[:_MAX_CHARS], _MAX_CHARS)
        if line != shown:
            tell(line)
            shown = line
        left = deadline.left_s()
        time.sleep(_POLL_S if left is None else min(_POLL_S, left))


def _facts(facts: dict[str, object], order: m.NeedPackages) -> dict[str, Any]:
    """Return the facts for the provenance. Trust: input from the server; only types are checked."""
    lock, pins = (facts.get(name) for name in _FACTS)
    if not isinstance(lock, str) or not isinstance(pins, (list, tuple)) or len(pins) > _MAX_PINS:
        raise RemoteProtocolError("the server does not say which packages it has made")
    texts = [printable(str(pin)[:_MAX_CHARS], _MAX_CHARS) for pin in pins]
    kept = {"lock": printable(lock[:_MAX_CHARS], _MAX_CHARS), "packages": texts}
    # Trust: input from the server.
    said = facts.get("inferred")
    rows = said if isinstance(said, (list, tuple)) else ()
    modules = {str(row.get("module")) for row in rows[:_MAX_PINS] if isinstance(row, dict)}
    inferred = [
        {"module": module, "requirement": requirement, "where": where}
        for requirement, where, module, _ in cast("tuple[tuple[str, ...], ...]", order.guesses)
        if module in modules
    ]
    return {**kept, "inferred": inferred} if inferred else kept


@dataclass(eq=False)
class UploadedRepository(Sandbox):
    """The sandbox of one repository, which uploads the repository's files to a server.
    ``order``: the request for the packages that the server made; None if it made none.
    ``packages``: the server's name for these packages.
    """

    snapshot: Path
    order: m.NeedPackages | None
    packages: str
    _files: dict[Path, tuple[Sent, ...]] = field(default_factory=dict, init=False)

    def prepare(
        self, order: m.OpenJail, server: WorkerServer, client: WorkerConnection, deadline: Deadline
    ) -> m.OpenJail:
        """Upload the files and check the packages, in one thread of this process at a time."""
        with server.uploading:
            if self.order is not None:
                # the server makes them again if it is new or has removed them, which does not
                # count towards the timeout of a start
                began = time.monotonic()
                deadline.postpone(_MAKE_S)
                try:
                    packages = request_packages(self.order, client, deadline)
                finally:
                    deadline.postpone(time.monotonic() - began - _MAKE_S)
                if packages is None or packages.packages != self.packages:
                    raise DependencyError(
                        "the server no longer has these packages, and would choose other versions "
                        "now: make the environment again"
                    )
            here = {copy.tree for copy in order.repositories if copy.tree}
            trees = {tree: self._bring(Path(tree), client, deadline) for tree in sorted(here)}
            snapshot = self._bring(self.snapshot, client, deadline)
        order = m.replace(order, hub_copies=order.with_trees(trees))
        return m.replace(order, snapshot=snapshot, python="", packages=self.packages)

    def _bring(self, root: Path, client: WorkerConnection, deadline: Deadline) -> str:
        """Upload a folder of files, and return the server's name for it."""
        if root not in self._files:
            self._files[root] = listing(root)
        return upload(client, root, self._files[root], deadline)[0]
