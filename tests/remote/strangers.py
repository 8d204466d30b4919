"""Connections without ZeroMQ, which say what they like."""

import contextlib
import socket

GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x01"
"""How a ZMTP 3.1 greeting begins: the signature and the version; a mechanism follows."""
_PATIENCE_S = 120.0


def greeting(mechanism: bytes) -> bytes:
    return GREETING + mechanism.ljust(20, b"\0") + b"\0" + bytes(31)


def knock(port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), _PATIENCE_S)


def say(connection: socket.socket, data: bytes) -> None:
    """Send, whether anybody listens any more or not."""
    with contextlib.suppress(OSError):
        connection.sendall(data)


def hears(connection: socket.socket) -> bytes:
    """All that comes until the other end closes, which it has to do."""
    connection.settimeout(_PATIENCE_S)
    heard = b""
    with contextlib.suppress(ConnectionError):
        while piece := connection.recv(1 << 16):
            heard += piece
    return heard


def ends(connection: socket.socket) -> bool:
    """Whether the server ends a connection; what it says before is not ours to read."""
    hears(connection)
    return True
