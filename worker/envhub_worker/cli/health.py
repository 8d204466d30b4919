"""Whether a server answers on an address: what a container's health check asks."""

from __future__ import annotations

import socket

# ZMTP 3: how both sides begin, unasked, before any key is needed (https://rfc.zeromq.org/spec/23).
_GREETING = b"\xff"
_WAIT_S = 5.0


def answers(host: str, port: int) -> bool:
    """Whether a ZeroMQ peer greets us there."""
    try:
        with socket.create_connection((host, port), _WAIT_S) as connection:
            greeting = connection.recv(1)
    except OSError:
        return False
    return greeting == _GREETING
