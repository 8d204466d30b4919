"""A connection to a server on another host: its keys, its heartbeat, and its failures.

libzmq reconnects for ever without a message: a wrong key, a port without a listener and an
unplugged cable look alike. This module turns the events of libzmq's socket monitor into errors.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection
from dataclasses import field
from time import monotonic
from weakref import WeakSet

import zmq
from zmq.utils import z85

from envhub_sandbox.errors import EnvHubError, SandboxUnavailableError, WorkerDiedError
from envhub_sandbox.system.platform import OwnerProcess
from envhub_sandbox.transport.replies import UnreachableError
from envhub_worker.protocol.records import dataclass

CONNECT_S = 10.0
"""Seconds for a server to accept the first connection, or to return after a lost connection."""
_CUT_S = 3.0
"""After a server has ended handshakes for so many seconds, it counts as unreachable."""
_ANOTHER_PROTOCOL = (
    "it does not speak ZeroMQ with CURVE keys: is it an envhub-worker, and do both sides use "
    "keys, or neither (insecure_loopback)?"
)
_RECONNECT_MS = 100
_RECONNECT_MAX_MS = 2_000
_PINGS = 4
_EVENTS_NOW, _READABLE = int(zmq.EVENTS), int(zmq.POLLIN)
_EVENTS = (
    zmq.EVENT_HANDSHAKE_SUCCEEDED
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_DISCONNECTED
)


@dataclass(frozen=True)
class TcpServer:
    """The keys and the connections of a server on another host.

    Attributes:
        server_key: The server's public key; None only for ``insecure_loopback``.
        client_key: This client's secret key; None only for ``insecure_loopback``.
        heartbeat_s: After so many seconds without a heartbeat a connection counts as lost.
        held: The numbers of the jails that this process has open on the server.
        links: The connections; a thread calls ``TcpLink.read_ahead`` of each every few seconds.
        why_ended: Returns the reason of the server's end, to append to a text; may take seconds.
    """

    server_key: bytes | None
    client_key: bytes | None = field(repr=False)
    heartbeat_s: float = 30.0
    held: set[int] = field(default_factory=set, compare=False)
    links: WeakSet[TcpLink] = field(default_factory=WeakSet, compare=False, repr=False)
    why_ended: Callable[[], str] = field(default=str, compare=False, repr=False)

    def link(self, socket: zmq.Socket[bytes], endpoint: str) -> TcpLink:
        """Make the ``TcpLink`` of a socket that has not connected yet."""
        return TcpLink(socket, endpoint, self)

    def public_key(self) -> str:
        """Return this client's public key in the form of the server's ``--authorized-clients``."""
        if self.client_key is None:
            return "none"
        return z85.decode(zmq.curve_public(z85.encode(self.client_key))).hex()


def new_keys() -> tuple[bytes, bytes]:
    """Make a CURVE key pair: the public and the secret key, of 32 bytes each."""
    public, secret = zmq.curve_keypair()
    return z85.decode(public), z85.decode(secret)


class TcpLink:
    """Watches the connection of one socket. It must be made before the socket connects.
    ``awaited``: the unanswered requests. While there are any, only the socket's owner reads the
    monitor's events.
    ``lock``: a thread holds it while it adds to ``awaited``, or reads events in ``read_ahead``.
    """

    def __init__(self, socket: zmq.Socket[bytes], endpoint: str, far: TcpServer) -> None:
        self._endpoint = endpoint
        self._far = far
        self._socket = socket
        self._since = monotonic()
        self._up = False
        self._number = 0
        self._lost = 0
        self._cut_since = 0.0
        self._refusal: EnvHubError | None = None
        self._owner = OwnerProcess()
        self.awaited: Collection[int] = ()
        self.lock = threading.RLock()  # interruption.md, rule 12
        self._set_options(socket, far)
        self.monitor = socket.get_monitor_socket(_EVENTS)
        # a server that ends every connection causes a dozen events a second; with a bounded queue,
        # a full one would block libzmq's thread, and with it all connections of this process
        self.monitor.setsockopt(zmq.RCVHWM, 0)
        far.links.add(self)

    def _set_options(self, socket: zmq.Socket[bytes], far: TcpServer) -> None:
        heartbeat_ms = max(1, int(far.heartbeat_s * 1000))
        socket.setsockopt(zmq.IPV6, "[" in self._endpoint)
        socket.setsockopt(zmq.HEARTBEAT_IVL, max(1, heartbeat_ms // _PINGS))
        socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, heartbeat_ms)
        socket.setsockopt(zmq.CONNECT_TIMEOUT, int(CONNECT_S * 1000))
        socket.setsockopt(zmq.RECONNECT_IVL, _RECONNECT_MS)
        socket.setsockopt(zmq.RECONNECT_IVL_MAX, _RECONNECT_MAX_MS)
        if far.server_key is not None and far.client_key is not None:
            socket.setsockopt(zmq.CURVE_SERVERKEY, far.server_key)
            socket.setsockopt(zmq.CURVE_SECRETKEY, z85.encode(far.client_key))
            socket.setsockopt(zmq.CURVE_PUBLICKEY, zmq.curve_public(z85.encode(far.client_key)))

    def next_number(self) -> int:
        """Return the number of the connection that carries the next message."""
        self.drain()
        return self._number if self._up else self._number + 1

    def read_ahead(self) -> None:
        """Read the events of an idle connection; any thread may call this.

        Unread events take memory without a bound if the server ends each new connection. The next
        ``drain`` raises a refusal that is read here.
        """
        if not self._owner.is_here or not self.lock.acquire(blocking=False):
            return
        try:
            while not (self.awaited or self.monitor.closed):
                try:
                    self._read()
                    return
                except EnvHubError as error:
                    self._refusal = error
        finally:
            self.lock.release()

    def drain(self) -> None:
        """Read the monitor's events.
        Raises ``SandboxUnavailableError``: the server rejects this client, or speaks another
        protocol; ``WorkerDiedError``: the server accepted this client before, and rejects it now.
        """
        if self._refusal is not None:
            refusal, self._refusal = self._refusal, None
            raise refusal
        self._read()

    def _read(self) -> None:
        if not int(self.monitor.getsockopt(_EVENTS_NOW)) & _READABLE:
            return  # the usual case; this test is cheaper than zmq.Again
        from zmq.utils.monitor import parse_monitor_message  # late: it imports asyncio and ssl

        while True:
            try:
                frames = self.monitor.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            self._happened(parse_monitor_message(frames)["event"])

    def _happened(self, event: int) -> None:
        if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            self._up, self._refusal = True, None
            self._number += 1
        elif event == zmq.EVENT_DISCONNECTED:
            if self._up:
                self._up, self._lost, self._since = False, self._number, monotonic()
        elif event == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
            raise self._refused(
                f"the server does not know our key: add {self._far.public_key()} to its "
                "--authorized-clients, or use the key that it printed"
            )
        elif event == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL:
            raise self._refused(_ANOTHER_PROTOCOL)
        elif self._number == 0:
            self._cut_off()

    def _cut_off(self) -> None:
        """Raise if the server has ended handshakes for ``_CUT_S``; until then libzmq tries again.

        A stopping server ends handshakes, too, and so does a forwarded port without a server.
        """
        self._cut_since = self._cut_since or monotonic()
        if monotonic() - self._cut_since < _CUT_S:
            return
        if self._far.server_key is None:
            raise self._refused(_ANOTHER_PROTOCOL)
        raise UnreachableError(
            f"{self._endpoint}: it has ended every handshake for {_CUT_S:.0f} s. Either the server "
            "has another public key than the given server_key, or it is restarting: compare the "
            "key with the one that it printed, and check that it runs"
        )

    def _refused(self, why: str) -> EnvHubError:
        text = f"{self._endpoint}: {why}"
        if self._number:
            return WorkerDiedError(text, reason="connection")
        return SandboxUnavailableError(text)

    def check(self, number: int) -> None:
        """Raise if a reply can no longer come to a message that connection ``number`` carried.
        Raises ``WorkerDiedError``: the connection was lost; ``SandboxUnavailableError``: no
        connection has ever succeeded.
        """
        self.drain()
        if number <= self._lost:
            raise WorkerDiedError(
                f"the connection to {self._endpoint} was lost while an answer was awaited; the "
                f"server, the network or its peer's heartbeat has failed{self._far.why_ended()}",
                reason="connection",
            )
        if self._up or monotonic() - self._since < CONNECT_S:
            return
        if self._number:
            raise WorkerDiedError(
                f"the connection to {self._endpoint} was lost and has not come back after "
                f"{CONNECT_S:.0f} s{self._far.why_ended()}",
                reason="connection",
            )
        raise UnreachableError(
            f"nothing answers at {self._endpoint} after {CONNECT_S:.0f} s; is 'envhub-worker "
            "listen' running there, and does a firewall let us through?"
        )

    def close(self) -> None:
        """Stop watching the connection."""
        with self.lock:
            self._socket.disable_monitor()
            self.monitor.close(0)
