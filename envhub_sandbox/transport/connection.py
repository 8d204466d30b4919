"""One connection to a worker server: requests, deadlines, late replies. Knows no Gymnasium."""

from __future__ import annotations

import contextlib
import itertools
import os
import secrets
import select
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import zmq

from envhub_sandbox.errors import (
    EnvHubError,
    RemoteProtocolError,
    VersionMismatchError,
    WorkerDiedError,
    WorkerError,
    WorkerTimeoutError,
)
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system.log import MESSAGES
from envhub_sandbox.system.platform import OwnerProcess, fork_error_text
from envhub_sandbox.system.threads import starting
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.replies import expect_reply
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.errors import UNTRUSTED
from envhub_worker.protocol.limits import DEFAULT_LIMITS, LARGE_BYTES, WireLimits
from envhub_worker.protocol.messages import compression

_NOW = int(zmq.NOBLOCK)
_MORE_NOW = int(zmq.SNDMORE) | _NOW
_EVENTS, _READABLE = int(zmq.EVENTS), int(zmq.POLLIN)
_KILLED_IN_A_CONTAINER = 128
"""A container engine adds this to the signal's number: the exit code of a killed container."""
_SIGKILL = 9
SESSION = secrets.token_bytes(16)
Source = Any
"""A descriptor or a ZeroMQ socket, which can be polled for input."""
_Received = tuple[m.Message, list[Buffer]]
_MOST_SOCKETS = 8192
"""A connection over a network has three sockets; ZeroMQ's default allows some 300 connections."""
_THREADS = 2
"""Of a context: one for input and output, and one that closes sockets."""
_contexts: dict[int, zmq.Context[zmq.Socket[bytes]]] = {}


def remote_session_id() -> bytes:
    """Our session's id on other hosts, to which a fork of this process is another client."""
    return SESSION + os.getpid().to_bytes(4, "little")


def _context() -> zmq.Context[zmq.Socket[bytes]]:
    """This process's ZeroMQ context; a fork makes its own, as it cannot use its parent's."""
    pid = os.getpid()
    if pid not in _contexts:
        _check_threads()
        _contexts.clear()
        _contexts[pid] = context = zmq.Context()
        context.set(zmq.MAX_SOCKETS, _MOST_SOCKETS)
    return _contexts[pid]


def _check_threads() -> None:
    """Raise ``WorkerStartupError`` if ZeroMQ's threads cannot be started: it would abort this
    process.
    """
    checked = threading.Event()
    threads = [threading.Thread(target=checked.wait, daemon=True) for _ in range(_THREADS)]
    try:
        with starting(f"the {_THREADS} threads of ZeroMQ"):
            for thread in threads:
                thread.start()
    finally:
        checked.set()
        for thread in threads:
            if thread.ident is not None:
                thread.join()


_LOOK_MS = 500
"""The longest single wait on a network connection, before its state is checked."""
_ROOM_S = 30.0
"""How long a socket may be full or unconnected before a message counts as lost."""


class FarServer(Protocol):
    """A server on another host: ``tcp.TcpServer``, of the extra that knows such servers."""

    @property
    def held(self) -> set[int]:
        """The numbers of the jails that we have open there."""

    @property
    def why_ended(self) -> Callable[[], str]:
        """Returns why the server has ended, as the rest of a sentence; may wait some seconds."""

    def link(self, socket: zmq.Socket[bytes], endpoint: str) -> Any:
        """A ``TcpLink``, which watches a socket before it connects."""


class WorkerConnection:
    """A connection to one worker server. Not thread-safe: its owner holds a lock.

    Args:
        endpoint: The server's ZeroMQ endpoint.
        process_fd: A descriptor that becomes readable when the server's process ends.
        limits: Bounds on what the server may send.
        far: The server's key and ours, if the server is on another host.

    Attributes:
        patience_s: How long the server keeps the jails of a silent client; 0: for ever.
        torn: Whether an interrupt may have left half a message in the socket, to which the next
            message would be added, or may have lost a reply that ``arrived`` was reading.
    """

    def __init__(
        self,
        endpoint: str,
        process_fd: int,
        limits: WireLimits = DEFAULT_LIMITS,
        far: FarServer | None = None,
    ) -> None:
        self._owner = OwnerProcess()  # a fork must not use the connection
        self._limits = limits
        self._ids = itertools.count(1)
        self._socket = _context().socket(zmq.DEALER)
        self._socket.setsockopt(zmq.LINGER, 0)  # a close waits for nobody
        self._socket.setsockopt(zmq.MAXMSGSIZE, limits.frame_bytes)  # checked before the allocation
        self._socket.setsockopt(zmq.RCVHWM, 64)  # replies that wait here; others wait at the server
        self._far = far
        # Before ``connect``: it has the socket prove its key, and hears of lost connections.
        self._link = None if far is None else far.link(self._socket, endpoint)
        self._socket.connect(endpoint)
        self._process_fd = process_fd
        self._sources: list[Source] = [self._socket, process_fd]
        if self._link is not None:
            self._sources.append(self._link.monitor)
        # Not ``zmq.Poller``, but where there is no other (Windows): before it sleeps, zmq_poll(3)
        # asks each socket twice, and to be asked takes three system calls.
        self._poller: Any = getattr(select, "poll", zmq.Poller)()
        for source in self._sources:
            self._poller.register(source, zmq.POLLIN)
        # Unanswered requests to another host by id, to be sent again over a new connection: the
        # number of the connection that each went over, and its frames.
        self._sent: dict[int, tuple[int, list[Buffer]]] = {}
        if self._link is not None:
            self._link.awaited = self._sent
        # The last message, encoded.
        self._packed: tuple[m.Message | None, list[Buffer]] = (None, [])
        self._latest: Buffer = b""  # the header of the last reply, whoever waited for it
        self._arrived: dict[int, _Received | EnvHubError] = {}  # read, but not received yet
        # Requests whose replies are kept if another reply is waited for.
        self._kept: set[int] = set()
        self.torn = False
        self._compression = ""  # agreed on with a server on another host
        self.patience_s = 0
        self.stale_replies = 0  # replies that nobody waited for any more
        self.sent_bytes = 0
        self.received_bytes = 0

    def hello(self, deadline: Deadline) -> m.Welcome:
        """Agree on a protocol version."""
        self._compression = ""
        session = SESSION if self._far is None else remote_session_id()
        offered = () if self._link is None else compression.available()
        greeting = m.Hello(m.VERSION, session, offered)
        reply, _ = self.request(greeting, deadline=deadline)
        welcome = expect_reply(reply, m.Welcome)
        if welcome.version != m.VERSION:
            raise VersionMismatchError(
                f"this client speaks protocol {m.VERSION}, the worker {welcome.version}: install "
                "the same release of envhub-sandbox on both sides"
            )
        if welcome.compression not in ("", *offered):
            raise RemoteProtocolError("the worker chose a compression that was not offered")
        self._compression, self.patience_s = welcome.compression, welcome.idle_s
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
        operation = getattr(message, "operation", "")
        MESSAGES.debug("> %d %s %s", request_id, type(message).__name__, operation)
        if message is not self._packed[0]:  # all steps send the same message object
            self._packed = message, m.pack(message)
        header, *buffers = self._packed[1]
        self._send(request_id, m.with_id(header, request_id, [*buffers, *payload]))
        return request_id

    def _send(self, request_id: int, frames: list[Buffer]) -> None:
        travelling = frames
        if self._link is not None:
            # noted before it is sent, so that ``receive`` can send it again over a new connection
            with self._link.lock:
                self._sent[request_id] = self._link.next_number(), frames
            if self._compression and len(frames) > 1:
                travelling = compression.pack_frames(frames, self._compression)
        size = sum(map(len, travelling))
        self._put(travelling, copy=size < LARGE_BYTES)
        self.sent_bytes += size

    def receive(self, request_id: int, deadline: Deadline) -> tuple[m.Message, list[Buffer]]:
        """Wait for the reply to a request; returns it with its payload.

        Other replies are dropped and counted, unless ``keep`` was called for their requests.
        Raises ``WorkerTimeoutError``: the deadline came first, and a late reply is dropped;
        ``WorkerDiedError``: the worker server has ended, or the connection to it is lost;
        ``SandboxUnavailableError``: a server on another host does not let us in;
        ``RemoteProtocolError``: the message that came is not a reply.
        """
        self.check_process()
        while True:
            arrived = self._arrived.pop(request_id, None)
            if isinstance(arrived, EnvHubError):
                raise arrived
            reply, payload = arrived or self._receive(request_id, deadline)
            unknown = isinstance(reply, m.Refusal) and reply.error == "HelloError"
            if not (unknown and request_id in self._sent):
                self._sent.pop(request_id, None)
                self._kept.discard(request_id)
                MESSAGES.debug("< %d %s", request_id, type(reply).__name__)
                return reply, payload
            # The server does not know this connection: the client said Hello on an earlier one, or
            # to an earlier server. The same request follows the new Hello, under the id that the
            # caller waits for.
            _, unanswered = self._sent.pop(request_id)
            self.hello(deadline)
            self._send(request_id, unanswered)

    def _receive(self, request_id: int, deadline: Deadline) -> _Received:
        while True:
            self._wait(request_id, deadline)
            frames = self._take()
            self._latest = frames[0]
            self.received_bytes += sum(map(len, frames))
            if self._link is not None and len(frames) > 1:
                with UNTRUSTED:
                    frames = compression.unpack_frames(frames, self._limits)
            reply_id, reply, payload = m.unpack_with_id(frames, limits=self._limits)
            if reply_id == request_id:
                return reply, payload
            if reply_id in self._kept:
                self._arrived[reply_id] = reply, payload
            else:
                self._sent.pop(reply_id, None)
                self.stale_replies += 1
            deadline.check()  # a flood of other replies must not extend the wait

    def arrived(self, request_id: int) -> bool:
        """Whether ``receive`` would return or raise at once. Never waits."""
        if request_id not in self._arrived:
            try:
                if not self._is_readable(request_id, 0):
                    return False
                self.torn = True  # interruption.md, rule 1
                self._arrived[request_id] = self._receive(request_id, Deadline(0))
            except WorkerTimeoutError:  # it was another reply
                self.torn = False
                return False
            except EnvHubError as error:
                self._arrived[request_id] = error
            self.torn = False
        return True

    def peek(self, request_id: int) -> tuple[m.Message | None, list[Buffer]]:
        """The reply that has ``arrived``, without removing it; None if an error has arrived."""
        arrived = self._arrived.get(request_id)
        return (None, []) if arrived is None or isinstance(arrived, EnvHubError) else arrived

    def keep(self, request_id: int) -> None:
        """Keep the reply to this request if it arrives while another reply is waited for."""
        self._kept.add(request_id)

    def forget(self, request_id: int) -> None:
        """Drop the reply to this request, whether or not it has ``arrived``."""
        self._kept.discard(request_id)
        self._arrived.pop(request_id, None)

    def sources(self) -> list[Source]:
        """What to poll for input before the next call of ``arrived``, at least twice a second."""
        return self._sources

    def reply_again(self, request_id: int, deadline: Deadline) -> m.Message:
        """The reply, without payload, to a request whose wait was interrupted.

        It may have been read before the interrupt. Raises as ``receive`` does.
        """
        if self._latest and m.number_of(self._latest) != 0:  # 0: compressed, so it has a payload
            reply_id, reply = m.unpack_header(self._latest, limits=self._limits)
            if reply_id == request_id:
                return reply
        return self.receive(request_id, deadline)[0]

    def _put(self, frames: Sequence[Buffer], *, copy: bool) -> None:
        deadline: Deadline | None = None
        while True:
            try:
                # frame by frame: pyzmq's own loop costs more than the calls in it
                self.torn = True  # interruption.md, rule 1
                for frame in frames[:-1]:
                    self._socket.send(frame, _MORE_NOW, copy)
                self._socket.send(frames[-1], _NOW, copy)
                self.torn = False
            except zmq.Again:  # the socket took no frame of the message, so all are sent again
                self.torn = False
                deadline = deadline or Deadline(_ROOM_S)
                self._wait_for_room(deadline)
            else:
                return

    def _wait_for_room(self, deadline: Deadline) -> None:
        """Wait until the socket takes a message.

        libzmq's own wait has no end after a refused handshake, which leaves no peer to send to.
        """
        while not self._socket.poll(min(_LOOK_MS, deadline.left_ms() or 0), zmq.POLLOUT):
            if self._process_fd in dict(self._poller.poll(0)):
                raise self._has_ended()
            if self._link is not None:
                self._link.check(self._link.next_number())
            deadline.check(f"the worker took no request for {_ROOM_S:.0f} s")

    def _has_ended(self) -> WorkerDiedError:
        reason = "" if self._far is None else self._far.why_ended()
        text = f"the worker server has ended{reason}{describe_exit(self._process_fd)}"
        return WorkerDiedError(text, reason="server")

    def _take(self) -> list[Buffer]:
        """Read one message. Large frames stay in ZeroMQ's memory until they are decoded."""
        frames: list[Buffer] = []
        more = True
        while more:
            frame = self._socket.recv(_NOW, copy=False)
            frames.append(frame.bytes if len(frame) < LARGE_BYTES else frame.buffer)
            more = frame.more
        return frames

    def _wait(self, request_id: int, deadline: Deadline) -> None:
        while not self._is_readable(request_id, self._wait_ms(deadline)):
            deadline.check()

    def _is_readable(self, request_id: int, wait_ms: int | None) -> bool:
        """Whether a message is there; raises the error if no reply to this request can come."""
        # The socket is asked before and after: its descriptor is readable only until the next call
        # of any of its functions.
        if self._has_message():
            return True
        ready = self._poller.poll(wait_ms)
        if self._has_message():
            return True
        if any(fd == self._process_fd for fd, _ in ready):
            raise self._has_ended()
        if self._link is not None and request_id in self._sent:
            self._link.check(self._sent[request_id][0])
        return False

    def _has_message(self) -> bool:
        return bool(int(self._socket.getsockopt(_EVENTS)) & _READABLE)

    def _wait_ms(self, deadline: Deadline) -> int | None:
        left = deadline.left_ms()
        if self._link is None:
            return left
        return _LOOK_MS if left is None else min(left, _LOOK_MS)

    def hold(self, jail: int) -> None:
        """Name the jail in keep-alive messages from now on, if the server is on another host."""
        if self._far is not None:
            self._far.held.add(jail)

    def let_go(self, jail: int) -> None:
        """Stop keeping the jail alive; the server will end it."""
        if self._far is not None:
            self._far.held.discard(jail)

    def check_process(self) -> None:
        """Raise ``WorkerError`` in a fork: the connection belongs to the parent."""
        if os.getpid() != self._owner.pid:
            raise WorkerError(fork_error_text(self._owner.pid))

    def close(self) -> None:
        """Close the connection. Idempotent; a fork touches nothing: interruption.md, rule 14."""
        if self._owner.is_here and not self._socket.closed:
            if self._link is not None:
                self._link.close()
            self._socket.close(0)


def describe_exit(process_fd: int) -> str:
    """How a server ended and what to do, as the rest of a sentence. Does not reap the process.
    ``process_fd``: a pidfd of the server, or of its container's monitor.
    """
    how = ""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):  # the process was reaped already, or this is no pidfd
            status = os.waitid(os.P_PIDFD, process_fd, os.WEXITED | os.WNOHANG | os.WNOWAIT)
            if status is not None:
                killed = status.si_code in (os.CLD_KILLED, os.CLD_DUMPED)
                how = _how_it_ended(status.si_status, killed=killed)
    fresh = option_name("restart", "on_reset")
    return f"{how}. The next make_env, or with {fresh} the next reset(), starts another"


def _how_it_ended(status: int, *, killed: bool) -> str:
    number = status if killed else status - _KILLED_IN_A_CONTAINER
    if not killed and number not in signal.valid_signals():
        return f", with exit code {status}"
    name = f"signal {number}"
    with contextlib.suppress(ValueError):
        name = signal.Signals(number).name
    text = f" by {name}" if killed else f" with its container, by {name}"
    if number == _SIGKILL:
        text += ", by another process or by the kernel, as where memory runs out (dmesg says so)"
        if not killed:
            text += "; the container's own limit is DockerSandbox(memory=...) in Python"
    return text
