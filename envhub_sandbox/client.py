"""One connection to a worker server: requests, deadlines, late replies. Knows no Gymnasium."""

from __future__ import annotations

import itertools
import os
import secrets
from collections.abc import Sequence

import zmq

from envhub_sandbox.deadline import Deadline
from envhub_sandbox.errors import (
    RemoteProtocolError,
    SandboxUnavailableError,
    VersionMismatchError,
    WorkerDiedError,
    WorkerError,
    WorkerTimeoutError,
)
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec import Buffer
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits
from envhub_worker.protocol.text import printable

SESSION = secrets.token_bytes(16)
_contexts: dict[int, zmq.Context[zmq.Socket[bytes]]] = {}


def _context() -> zmq.Context[zmq.Socket[bytes]]:
    """This process's ZeroMQ context: one that came through a fork cannot be used."""
    pid = os.getpid()
    if pid not in _contexts:
        _contexts.clear()
        _contexts[pid] = zmq.Context()
    return _contexts[pid]


class WorkerClient:
    """A connection. Not thread-safe: its owner holds a lock.

    Args:
        endpoint: The server's ZeroMQ endpoint.
        process_fd: A descriptor that becomes readable when the server's process ends.
        limits: Bounds on what the server may send.
    """

    def __init__(self, endpoint: str, process_fd: int, limits: WireLimits = DEFAULT_LIMITS) -> None:
        self._pid = os.getpid()
        self._limits = limits
        self._ids = itertools.count(1)
        self._socket = _context().socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.MAXMSGSIZE, limits.frame_bytes)
        self._socket.setsockopt(zmq.RCVHWM, 64)
        self._socket.connect(endpoint)
        self._process_fd = process_fd
        self._poller = zmq.Poller()
        self._poller.register(self._socket, zmq.POLLIN)
        self._poller.register(process_fd, zmq.POLLIN)
        self.stale_replies = 0
        self.sent_bytes = 0
        self.received_bytes = 0

    def hello(self, deadline: Deadline) -> m.Welcome:
        """Agree on a protocol version."""
        reply, _ = self.request(m.Hello(m.VERSION, m.VERSION, SESSION), deadline=deadline)
        welcome = expect(reply, m.Welcome)
        if welcome.version != m.VERSION:
            raise VersionMismatchError(
                f"this client speaks protocol {m.VERSION}, the worker chose {welcome.version}"
            )
        return welcome

    def request(
        self, message: m.Message, payload: Sequence[Buffer] = (), *, deadline: Deadline
    ) -> tuple[m.Message, list[Buffer]]:
        """Send a request and wait for its reply."""
        return self.receive(self.send(message, payload), deadline)

    def send(self, message: m.Message, payload: Sequence[Buffer] = ()) -> int:
        """Send a request; returns its id."""
        self.check_process()
        request_id = next(self._ids)
        frames = [*m.pack(message, request_id), *payload]
        self._socket.send_multipart(frames, copy=False)
        self.sent_bytes += sum(memoryview(frame).nbytes for frame in frames)
        return request_id

    def receive(self, request_id: int, deadline: Deadline) -> tuple[m.Message, list[Buffer]]:
        """The reply to a request, with its payload. Replies to others are dropped and counted.

        Raises:
            WorkerTimeoutError: The deadline came first. The reply may still come; it is dropped.
            WorkerDiedError: The worker server has ended.
            RemoteProtocolError: What came is not a reply.
        """
        self.check_process()
        while True:
            self._wait(deadline)
            frames: list[Buffer] = list(self._socket.recv_multipart(zmq.NOBLOCK))
            self.received_bytes += sum(map(len, frames))
            reply_id, reply = m.unpack(frames[:1], limits=self._limits)
            if reply_id == request_id:
                return reply, frames[1:]
            self.stale_replies += 1

    def _wait(self, deadline: Deadline) -> None:
        while True:
            ready = dict(self._poller.poll(deadline.left_ms()))
            if self._socket in ready:
                return
            if ready:
                raise WorkerDiedError("the worker server has ended", reason="server")
            if deadline.passed:
                raise WorkerTimeoutError("the worker did not answer in time")

    def check_process(self) -> None:
        """Refuse in a forked child: the connection belongs to the parent.

        Raises:
            WorkerError: This is not the process that made the connection.
        """
        if os.getpid() != self._pid:
            raise WorkerError(
                f"this environment belongs to process {self._pid}, and this is a fork of it "
                f"({os.getpid()}); call make_env here to get one of its own"
            )

    def close(self) -> None:
        """Close the connection. Idempotent; in a forked child nothing is touched."""
        if os.getpid() == self._pid:
            self._socket.close(0)


def expect(reply: m.Message, kind: type[m.M]) -> m.M:
    """The reply, if it is of the kind that the request asks for.

    Raises:
        SandboxUnavailableError: A layer of the confinement is missing.
        WorkerDiedError: A process of the jail ended.
        RemoteProtocolError: It is another message.
    """
    if isinstance(reply, kind):
        return reply
    if isinstance(reply, m.Refused):
        raise refusal(reply)
    if isinstance(reply, m.Died):
        raise death(reply)
    raise RemoteProtocolError(
        f"the worker answered with {type(reply).__name__} where {kind.__name__} belongs"
    )


def refusal(reply: m.Refused) -> Exception:
    """The error for a refused request. Trust: text from the worker."""
    message = printable(reply.message)
    if reply.error == "SandboxUnavailableError":
        layer = f"{printable(reply.layer)}: " if reply.layer else ""
        fix = f"\n{printable(reply.fix)}" if reply.fix else ""
        return SandboxUnavailableError(f"this host cannot enforce {layer}{message}{fix}")
    if reply.error == "VersionMismatchError":
        return VersionMismatchError(message)
    return WorkerError(message)


_REASONS = {
    "exit": "it exited",
    "signal": "a signal ended it",
    "out-of-memory": "it ran out of memory",
    "cpu-limit": "it used up its cpu limit",
    "disk-limit": "it used up its disk limit",
    "protocol": "it broke the rules of the wire and was killed",
    "killed": "it was closed",
    "zygote": "the process that forks workers ended",
}


def death(reply: m.Died) -> WorkerDiedError:
    """The error for a jail that ended."""
    how = _REASONS.get(reply.reason, reply.reason)
    if reply.signal:
        how += f" ({reply.signal})"
    elif reply.exit_code is not None:
        how += f" (exit code {reply.exit_code})"
    during = f" during {reply.operation}" if reply.operation else ""
    detail = f"\n{reply.detail}" if reply.detail else ""
    tail = f"\nIts last output:\n{reply.tail}" if reply.tail else ""
    return WorkerDiedError(
        f"the worker process died{during}: {how}{detail}{tail}",
        exit_code=reply.exit_code,
        signal=reply.signal,
        reason=reply.reason,
        log_tail=reply.tail,
        request=reply.operation or None,
        detail=reply.detail,
    )
