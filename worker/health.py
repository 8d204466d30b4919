"""Whether a server answers on an address: what a container's health check asks."""

from __future__ import annotations

import socket

# ZMTP 3: what both sides say first, before any key is needed (https://rfc.zeromq.org/spec/23).
_SIGNATURE = b"\xff" + bytes(8) + b"\x7f"
_WAIT_S = 5.0


def answers(host: str, port: int) -> bool:
    """Whether a ZeroMQ peer greets us there."""
    try:
        with socket.create_connection((host, port), _WAIT_S) as connection:
            connection.sendall(_SIGNATURE)
            greeting = connection.recv(1)
    except OSError:
        return False
    return greeting == _SIGNATURE[:1]
