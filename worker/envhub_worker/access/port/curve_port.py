"""A TCP port whose clients prove a key before they are heard, and what bounds who keeps no rule."""

from __future__ import annotations

from collections.abc import Callable

import zmq

from envhub_worker.access.gate import Arrived
from envhub_worker.access.keys import KeyPair
from envhub_worker.access.port.connection_limit import Doorman
from envhub_worker.access.port.zap import DOMAIN, Zap
from envhub_worker.access.telling.rate_limited_log import Log
from envhub_worker.loop import Loop
from envhub_worker.multipart import receive
from envhub_worker.protocol.keys import KEY_BYTES

_HANDSHAKE_MS = 5_000
_HEARTBEAT_MS = 15_000
_HEARTBEAT_TIMEOUT_MS = 60_000
_BACKLOG = 64
_SNDHWM = 32
ANYBODY = bytes(KEY_BYTES)
"""The key of clients that have none, behind ``--insecure-loopback``."""


class CurvePort:
    """What a ``RemoteGate`` does at its socket.

    Args:
        keys: The server's key pair; None only for ``--insecure-loopback``.
        admits: Whether a key at an address may come in.
        log: Takes what is refused.
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
        self._doorman: Doorman | None = None

    def secure(self, router: zmq.Socket[bytes], loop: Loop) -> None:
        """CURVE, and what bounds a peer that keeps none of the rules."""
        router.setsockopt(zmq.HANDSHAKE_IVL, _HANDSHAKE_MS)
        router.setsockopt(zmq.HEARTBEAT_IVL, _HEARTBEAT_MS)
        router.setsockopt(zmq.HEARTBEAT_TIMEOUT, _HEARTBEAT_TIMEOUT_MS)
        router.setsockopt(zmq.BACKLOG, _BACKLOG)
        router.setsockopt(zmq.SNDHWM, _SNDHWM)
        self._doorman = Doorman(router, loop, self._log, self._max_connections)
        self._closers.append(self._doorman.close)
        keys = self._keys
        if keys is None:
            return
        zap = Zap(router.context, self._admits)
        self._closers.append(zap.close)
        loop.watch(zap.socket, zap.answer)
        router.setsockopt(zmq.CURVE_SERVER, 1)
        router.setsockopt(zmq.CURVE_SECRETKEY, keys.secret)
        router.setsockopt(zmq.ZAP_DOMAIN, DOMAIN)
        # without it libzmq lets everybody in whom no handler was there to ask about
        router.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)

    def receive(self, router: zmq.Socket[bytes]) -> Arrived:
        """The key is the one that was proved in the handshake, never what the peer claims."""
        identity = router.recv(zmq.NOBLOCK)
        # not of the frame before: libzmq 4.3.4 knows nothing of who sent the first one
        header = router.recv(zmq.NOBLOCK, copy=False)
        rest = receive(router) if header.more else []
        frames = [header.bytes, *rest]
        return Arrived(identity, self._key_of(header), frames, _descriptor_of(header))

    def _key_of(self, frame: zmq.Frame) -> bytes:
        if self._keys is None:
            return ANYBODY
        try:
            return bytes.fromhex(str(frame.get("User-Id")))
        except (zmq.ZMQError, ValueError):
            return b""

    def wire(self, descriptor: int) -> int | None:
        """The connection that a message came over; None if that is not known."""
        if self._doorman is None or descriptor < 0:
            return None
        return self._doorman.wire(descriptor)

    def open_wires(self) -> frozenset[int] | None:
        """The connections that are there; None if nobody counts them."""
        return None if self._doorman is None else self._doorman.open_wires()

    def tick(self) -> None:
        """Time has passed."""
        if self._doorman is not None:
            self._doorman.tick()

    def close(self) -> None:
        """Close the sockets of the handshakes."""
        for close in self._closers:
            close()


def _descriptor_of(frame: zmq.Frame) -> int:
    try:
        return int(frame.get(zmq.SRCFD))
    except (zmq.ZMQError, ValueError):
        return -1
