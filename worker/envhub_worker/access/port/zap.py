"""Who may come in: ZeroMQ's authentication protocol, answered in the server's own loop.

Followed: https://rfc.zeromq.org/spec/27. pyzmq's authenticators have a thread or an event loop of
their own; the server has one thread and one poll, so this asks for no lock.
"""

from __future__ import annotations

from collections.abc import Callable

import zmq

_ENDPOINT = "inproc://zeromq.zap.01"
_VERSION = b"1.0"
_FRAMES = 9
DOMAIN = b"envhub"


class Zap:
    """Answers libzmq's questions about each handshake.

    Args:
        admits: Called with the client's public key and address; whether it may come in.
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
        if len(frames) != _FRAMES or frames[2] != _VERSION or frames[4] != DOMAIN:
            return b""
        address, mechanism, key = frames[5], frames[7], frames[8]
        if mechanism != b"CURVE" or not self._admits(key, address.decode("ascii", "replace")):
            return b""
        return key

    def close(self) -> None:
        """Close the socket."""
        self.socket.close()
