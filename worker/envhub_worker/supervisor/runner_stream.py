"""The server's end of the stream to one runner: bounded both ways, never blocking."""

from __future__ import annotations

import collections
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.protocol.limits import LARGE_BYTES, WireLimits
from envhub_worker.protocol.stream import Packet, StreamReader, pack_packet
from envhub_worker.supervisor.served_slabs import ServedSlabs

_MAX_IOVECS = 512


@dataclass
class RunnerLink:
    """One runner's stream.

    Attributes:
        pending: The owners of unanswered requests by id, the oldest first.
        watched: Whether the loop watches the stream for writing.
        slabs: The slabs by which the server steps the runner, or None.
        take: Takes the answer to such a step; made for the first one.
    """

    sock: socket.socket
    limits: WireLimits
    pending: collections.OrderedDict[int, Any] = field(default_factory=collections.OrderedDict)
    watched: bool = False
    slabs: ServedSlabs | None = None
    take: Callable[[], None] | None = None
    sent: int = 0  # bytes; after the end ``JailRecord.moved`` has them
    received: int = 0  # likewise
    # Requests that the socket has not taken yet; the first may be sent in part.
    _unsent: collections.deque[memoryview] = field(default_factory=collections.deque)

    def __post_init__(self) -> None:
        self.sock.setblocking(False)
        self._reader = StreamReader(self.limits, self._check_owed)

    def fileno(self) -> int:
        """The stream's descriptor."""
        return self.sock.fileno()

    @property
    def unanswered(self) -> int:
        """How many requests the runner has not answered."""
        return len(self.pending) + (self.slabs is not None and self.slabs.owner is not None)

    @property
    def owed(self) -> list[Any]:
        """The owners of unanswered requests, the oldest first; a step in slabs comes last."""
        owners = list(self.pending.values())
        if self.slabs is not None and self.slabs.owner is not None:
            owners.append(self.slabs.owner)
        return owners

    def owe_nothing(self) -> None:
        """Drop all requests that the runner has not answered."""
        self.pending.clear()
        if self.slabs is not None:
            self.slabs.owner = None

    @property
    def wants_write(self) -> bool:
        """Whether unsent bytes wait."""
        return bool(self._unsent)

    def send(
        self, request_id: int, frames: Sequence[Buffer], owner: Any, fds: Sequence[int] = ()
    ) -> None:
        """Queue a request and send as much as the socket takes. ``fds`` stay the caller's."""
        if fds:
            self._send_fds(request_id, frames, fds)
            self.pending[request_id] = owner
            return
        self.pending[request_id] = owner
        buffers = pack_packet(request_id, frames)
        size = sum(map(len, buffers))
        self.sent += size
        if size < LARGE_BYTES:
            # One copy costs less than many vectors; large arrays are sent from where they lie.
            buffers = [b"".join(buffers)]
        self._unsent += [memoryview(buffer).cast("B") for buffer in buffers if buffer]
        self.flush()

    def _send_fds(self, request_id: int, frames: Sequence[Buffer], fds: Sequence[int]) -> None:
        """Send a small packet in one piece: its descriptors arrive with its first byte."""
        if self._unsent:
            raise RuntimeError("the runner is still being sent another request")
        data = b"".join(map(bytes, pack_packet(request_id, frames)))
        try:
            sent = socket.send_fds(self.sock, [data], fds)
        except OSError:
            return  # the runner has exited, and its exit event completes the request
        if sent != len(data):
            raise RuntimeError("the runner does not read its stream")

    def flush(self) -> None:
        """Send as much as the socket takes. An ended runner is noticed by its exit event."""
        while self._unsent:
            batch = [self._unsent[i] for i in range(min(len(self._unsent), _MAX_IOVECS))]
            try:
                sent = self.sock.sendmsg(batch, (), socket.MSG_NOSIGNAL)
            except BlockingIOError:
                return
            except OSError:
                self._unsent.clear()
                return
            while self._unsent and sent >= self._unsent[0].nbytes:
                sent -= self._unsent.popleft().nbytes
            if sent:
                self._unsent[0] = self._unsent[0][sent:]

    def receive(self) -> list[tuple[Packet, Any]] | None:
        """Returns the arrived replies with their owners, or None at the end of the stream.
        Raises ``RemoteProtocolError``: the runner sent an unexpected packet. Trust: the runner is
        hostile.
        """
        room, data = self._reader.room, b""
        try:
            if room is None:
                data = self.sock.recv(self._reader.chunk)
            size = len(data) if room is None else self.sock.recv_into(room)
        except BlockingIOError:
            return []
        except OSError:
            return None
        if not size:
            return None
        self.received += size
        answers = []
        try:
            for packet in self._reader.feed(data) if room is None else self._reader.filled(size):
                answers.append((packet, self.pending.pop(packet.request_id)))
        except RemoteProtocolError:
            # Replies before the offence are dropped, too: their owners get the runner's death.
            self.pending.update((packet.request_id, owner) for packet, owner in answers)
            raise
        return answers

    def _check_owed(self, request_id: int) -> None:
        """Refuse an unexpected reply before memory is allocated for it."""
        expected = next(iter(self.pending), None)
        if request_id != expected:
            raise RemoteProtocolError(
                f"the runner answered request {request_id}, it owes {expected}"
            )

    def close(self) -> None:
        """Close the stream. Idempotent."""
        self._unsent.clear()
        self.sock.close()
