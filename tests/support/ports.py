"""Ports for programs that bind them themselves."""

from __future__ import annotations

import contextlib
import random
import socket


def lasting_port() -> int:
    """A port below those that the kernel gives to anybody: it is still free a while later."""
    while True:
        number = random.randrange(20_000, 32_000)
        with contextlib.suppress(OSError), socket.socket() as sock:
            sock.bind(("127.0.0.1", number))
            return number
