"""A TCP port whose clients prove a key before they are heard; it bounds peers without rules.

``Zap`` answers ZeroMQ's authentication protocol (https://rfc.zeromq.org/spec/27) in the server's
own loop. pyzmq's authenticators have a thread or an event loop of their own; the server has one
thread and one poll, so this asks for no lock.
"""

from __future__ import annotations

from collections.abc import Callable

import zmq

from envhub_worker.access.audit.log import Log
from envhub_worker.access.gate import Incoming
from envhub_worker.access.keys import KeyPair
from envhub_worker.access.port.connection_limit import ConnectionLimiter
from envhub_worker.loop import Loop, receive
from envhub_worker.protocol.keys import KEY_BYTES

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


class CurvePort:
    """What a ``RemoteGate`` does at its socket.

    Args:
        keys: The server's key pair; None only for ``--insecure-loopback``.
        max_connections: Of everybody together, strangers included.
    """

    def __init__(
        self,
        keys: KeyPair | None,
        admits: Callable[[bytes, str], bool],
        log: Log,
        max_connections: int,
    ) -> None:
        self._keys, self._admits = keys, admits
        self._log, self._max_connections = log, max_connections
        self._closers: list[Callable[[], None]] = []
        self._limiter: ConnectionLimiter | None = None

    def secure(self, router: zmq.Socket[bytes], loop: Loop) -> None:
        """CURVE, and what bounds a peer that keeps none of the rules."""
        router.setsockopt(zmq.HANDSHAKE_IVL, _HANDSHAKE_MS)
        router.setsockopt(zmq.HEARTBEAT_IVL, _HEARTBEAT_MS)
        router.setsockopt(zmq.HEARTBEAT_TIMEOUT, _HEARTBEAT_TIMEOUT_MS)
        router.setsockopt(zmq.BACKLOG, _BACKLOG)
        router.setsockopt(zmq.SNDHWM, _SNDHWM)
        self._limiter = ConnectionLimiter(router, loop, self._log, self._max_connections)
        self._closers.append(self._limiter.close)
        keys = self._keys
        if keys is None:
            return
        zap = Zap(router.context, self._admits)
        self._closers.append(zap.close)
        loop.watch(zap.socket, zap.answer)
        router.setsockopt(zmq.CURVE_SERVER, 1)
        router.setsockopt(zmq.CURVE_SECRETKEY, keys.secret)
        router.setsockopt(zmq.ZAP_DOMAIN, _DOMAIN)
        # without it libzmq lets everybody in whom no handler was there to ask about
        router.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)

    def receive(self, router: zmq.Socket[bytes]) -> Incoming:
        """The key is the one that was proved in the handshake, never what the peer claims."""
        identity = router.recv(zmq.NOBLOCK)
        # not of the frame before: libzmq 4.3.4 knows nothing of who sent the first one
        header = router.recv(zmq.NOBLOCK, copy=False)
        rest = receive(router) if header.more else []
        frames = [header.bytes, *rest]
        return Incoming(identity, self._key_of(header), frames, _descriptor_of(header))

    def _key_of(self, frame: zmq.Frame) -> bytes:
        if self._keys is None:
            return ANYBODY
        try:
            return bytes.fromhex(str(frame.get("User-Id")))
        except (zmq.ZMQError, ValueError):
            return b""

    def wire(self, descriptor: int) -> int | None:
        """The connection that a message came over; None if that is not known."""
        if self._limiter is None or descriptor < 0:
            return None
        return self._limiter.wire(descriptor)

    def open_wires(self) -> frozenset[int] | None:
        """The connections that are there; None if they are not counted."""
        return None if self._limiter is None else self._limiter.open_wires()

    def tick(self) -> None:
        """Time has passed."""
        if self._limiter is not None:
            self._limiter.tick()

    def close(self) -> None:
        """Close the sockets of the handshakes."""
        for close in self._closers:
            close()


def _descriptor_of(frame: zmq.Frame) -> int:
    try:
        return int(frame.get(zmq.SRCFD))
    except (zmq.ZMQError, ValueError):
        return -1


class Zap:
    """Answers libzmq's questions about each handshake.
    ``admits``: called with the client's public key and address; whether it may come in.
    """

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], admits: Callable[[bytes, str], bool]
    ) -> None:
        self._admits = admits
        self.socket = context.socket(zmq.ROUTER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.bind(_ENDPOINT)

    def answer(self) -> None:
        """Answer every question that is there."""
        while True:
            try:
                frames = self.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            # return address, empty, version, id, domain, address, routing id, mechanism, key
            key = self._key(frames)
            status = [b"200", b"OK", key.hex().encode()] if key else [b"400", b"not known", b""]
            # the last frame is metadata; the one before it becomes the messages' User-Id
            self.socket.send_multipart([frames[0], b"", _VERSION, frames[3], *status, b""])

    def _key(self, frames: list[bytes]) -> bytes:
        if len(frames) != _FRAMES or frames[2] != _VERSION or frames[4] != _DOMAIN:
            return b""
        address, mechanism, key = frames[5], frames[7], frames[8]
        if mechanism != b"CURVE" or not self._admits(key, address.decode("ascii", "replace")):
            return b""
        return key

    def close(self) -> None:
        """Close the socket."""
        self.socket.close()
