"""A TCP port that reads messages only from clients with a proved key, and limits all connections.

``CurvePort`` answers ZeroMQ's authentication protocol (ZAP, https://rfc.zeromq.org/spec/27) in the
server's own loop. pyzmq's authenticators have a thread or an event loop of their own; this one
needs no lock, since the server has one thread and one poll.

``ConnectionLimiter`` counts open connections and admits no more if there are too many. Strangers
open connections, too, and each takes a descriptor and memory before a key is checked. libzmq cannot
pause its listener, and closes a listener's connections with it. So a socket filter makes the kernel
drop new connections: open ones stay, and a peer that tries again later gets in.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import socket
import stat
import struct
from collections.abc import Callable
from functools import lru_cache, partial

import zmq

from envhub_worker.extras.access.audit.log import Log
from envhub_worker.extras.access.keys import KeyPair
from envhub_worker.loop import Loop, receive
from envhub_worker.protocol.keys import KEY_BYTES
from envhub_worker.server.gate import Incoming

_HANDSHAKE_MS = 5_000
_HEARTBEAT_MS = 15_000
_HEARTBEAT_TIMEOUT_MS = 60_000
_BACKLOG = 64
_SNDHWM = 32
_ENDPOINT = "inproc://zeromq.zap.01"
_VERSION = b"1.0"
_FRAMES = 9
_DOMAIN = b"envhub"
ANYBODY = bytes(KEY_BYTES)
"""The key of clients that have none, behind ``--insecure-loopback``."""

_FAILED = zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
_EVENTS = _FAILED | zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED
_EVENT = struct.Struct("=HI")  # a monitor's first frame: what, and a number (zmq_socket_monitor(3))
_SO_ATTACH_FILTER = 26
_SO_DETACH_FILTER = 27
_DROP = struct.pack("=HBBI", 0x06, 0, 0, 0)  # BPF: return 0 bytes of the packet


class CurvePort:
    """The socket of a ``RemoteGate``: CURVE authentication, and limits for every peer.

    Args:
        router: The socket, not bound yet.
        keys: The server's key pair; None only for ``--insecure-loopback``.
        admits: Called with a client's public key and address; returns whether it may connect.
        max_connections: Maximum number of connections, strangers' included.

    Attributes:
        connections: The open connections.
    """

    def __init__(
        self,
        router: zmq.Socket[bytes],
        loop: Loop,
        keys: KeyPair | None,
        admits: Callable[[bytes, str], bool],
        log: Log,
        max_connections: int,
    ) -> None:
        self._keys, self._admits = keys, admits
        self._zap: zmq.Socket[bytes] | None = None
        router.setsockopt(zmq.HANDSHAKE_IVL, _HANDSHAKE_MS)
        router.setsockopt(zmq.HEARTBEAT_IVL, _HEARTBEAT_MS)
        router.setsockopt(zmq.HEARTBEAT_TIMEOUT, _HEARTBEAT_TIMEOUT_MS)
        router.setsockopt(zmq.BACKLOG, _BACKLOG)
        router.setsockopt(zmq.SNDHWM, _SNDHWM)
        self.connections = ConnectionLimiter(router, loop, log, max_connections)
        if keys is None:
            return
        self._zap = router.context.socket(zmq.ROUTER)
        self._zap.setsockopt(zmq.LINGER, 0)
        self._zap.bind(_ENDPOINT)
        loop.watch(self._zap.fileno(), partial(self._answer, self._zap))
        router.setsockopt(zmq.CURVE_SERVER, 1)
        router.setsockopt(zmq.CURVE_SECRETKEY, keys.secret)
        router.setsockopt(zmq.ZAP_DOMAIN, _DOMAIN)
        # Without this option libzmq admits every peer if no ZAP handler is bound.
        router.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)

    def _answer(self, zap: zmq.Socket[bytes]) -> None:
        """Answer libzmq's waiting questions about handshakes."""
        while True:
            try:
                frames = zap.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            # return address, empty, version, id, domain, address, routing id, mechanism, key
            key = self._admitted(frames)
            status = [b"200", b"OK", key.hex().encode()] if key else [b"400", b"not known", b""]
            # the last frame is metadata; the one before it becomes the messages' User-Id
            zap.send_multipart([frames[0], b"", _VERSION, frames[3], *status, b""])

    def _admitted(self, frames: list[bytes]) -> bytes:
        if len(frames) != _FRAMES or frames[2] != _VERSION or frames[4] != _DOMAIN:
            return b""
        address, mechanism, key = frames[5], frames[7], frames[8]
        if mechanism != b"CURVE" or not self._admits(key, address.decode("ascii", "replace")):
            return b""
        return key

    def receive(self, router: zmq.Socket[bytes]) -> Incoming:
        """Receive a message; its key is the one proved in the handshake, not a peer's claim."""
        identity = router.recv(zmq.NOBLOCK)
        # From the last frame: libzmq 4.3.4 has no metadata of the first one.
        header = router.recv(zmq.NOBLOCK, copy=False)
        rest = receive(router) if header.more else []
        key = ANYBODY
        if self._keys is not None:
            try:
                key = _key(str(header.get("User-Id")))
            except (zmq.ZMQError, ValueError):
                key = b""
        return Incoming(identity, key, [header.bytes, *rest], header)

    def close(self) -> None:
        """Close the sockets of the handshakes."""
        self.connections.close()
        if self._zap is not None:
            self._zap.close()


class ConnectionLimiter:
    """Watches a socket's connections. Make it before the socket is bound.
    ``limit``: maximum of open connections; those in the backlog may still be added.
    """

    def __init__(self, router: zmq.Socket[bytes], loop: Loop, log: Log, limit: int) -> None:
        self._router = router
        self._log = log
        self._limit = limit
        self._open = 0
        self._accepted = 0
        self._wires: dict[int, int] = {}
        self._shut_listener: socket.socket | None = None
        self._monitor = router.get_monitor_socket(_EVENTS)
        loop.watch(self._monitor.fileno(), self._drain)

    def _drain(self) -> None:
        while True:
            try:
                frames = self._monitor.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            self._happened(*_EVENT.unpack_from(frames[0]))

    def _happened(self, event: int, value: int) -> None:
        if event == zmq.EVENT_ACCEPTED:
            self._open += 1
            self._accepted += 1
            self._wires[value] = self._accepted
            if self._open >= self._limit and self._shut_listener is None:
                self._shut()
        elif event == zmq.EVENT_DISCONNECTED:
            self._open -= 1
            self._wires.pop(value, None)
        else:
            self._log.say("handshake_failed", why="no key, another server's, or noise")

    def wire(self, header: zmq.Frame) -> int | None:
        """Returns the number of a message's connection; 0 if the connection has ended since, None
        if libzmq does not say which it was.

        Unlike a descriptor's number, this number is never reused. No connection has 0.
        """
        try:
            fd = int(header.get(zmq.SRCFD))
        except (zmq.ZMQError, ValueError):
            return None
        self._drain()  # libzmq says that it has accepted before it hands anything on
        return self._wires.get(fd, 0)

    def open_wires(self) -> frozenset[int]:
        """Returns the numbers of all open connections."""
        self._drain()
        return frozenset(self._wires.values())

    def _shut(self) -> None:
        """Drop new connections. If that fails, the next connection tries again."""
        listener = None
        try:
            listener = _listener(str(self._router.get_string(zmq.LAST_ENDPOINT)))
            if listener is None:
                return
            program = ctypes.create_string_buffer(_DROP)
            filters = struct.pack("@HP", 1, ctypes.addressof(program))
            listener.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, filters)
        except OSError as error:
            if listener is not None:
                listener.close()
            self._log.say("connections_full", connections=self._open, why=f"and no end: {error}")
            return
        self._shut_listener = listener
        self._log.say("connections_full", connections=self._open, why="no more for the moment")

    def tick(self) -> None:
        """Accept connections again once there is room."""
        if self._shut_listener is not None and self._open < self._limit:
            with contextlib.suppress(OSError):  # there is no filter any more
                self._shut_listener.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
            self._shut_listener.close()
            self._shut_listener = None

    def close(self) -> None:
        """Stop watching."""
        # libzmq blocks if many events are unread, with the lock that ``disable_monitor`` needs.
        self._drain()
        if self._shut_listener is not None:
            self._shut_listener.close()
        # In this order: a context does not end while the monitor's other end is open.
        self._router.disable_monitor()
        self._monitor.close()


@lru_cache(maxsize=1024)
def _key(text: str) -> bytes:
    return bytes.fromhex(text)


def _listener(endpoint: str) -> socket.socket | None:
    """Finds the listening socket of an endpoint by the kernel: libzmq does not expose it."""
    port = int(endpoint.rpartition(":")[2])
    for name in os.listdir("/proc/self/fd"):
        fd = int(name)
        with contextlib.suppress(OSError):  # it is closed by now, or there are too many
            if stat.S_ISSOCK(os.fstat(fd).st_mode) and _listens_on(fd, port):
                return socket.socket(fileno=os.dup(fd))
    return None


def _listens_on(fd: int, port: int) -> bool:
    theirs = socket.socket(fileno=fd)
    try:
        if theirs.family not in (socket.AF_INET, socket.AF_INET6):
            return False
        accepts = theirs.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)
        return bool(accepts) and theirs.getsockname()[1] == port
    finally:
        theirs.detach()  # it is libzmq's
