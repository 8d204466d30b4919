"""Floods of peers without keys, and of what clients with keys once sent: the others go on."""

import contextlib
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.remote.listening import Listening
from tests.remote.relay import relay
from tests.remote.strangers import ends, greeting, knock, say
from tests.support.started import started

_MIB = 1 << 20
_CURVE_GREETING = greeting(b"CURVE")
_HELLO_BYTES = 200
_PEERS = 150


@pytest.fixture
def captured(server: Listening, repository: Path) -> bytes:
    """All that a client with a key sent on one connection, from the greeting to its last step."""
    with relay(server.port) as wire:
        with started(repository, sandbox=server.sandbox(endpoint=wire.endpoint)) as env:
            env.step(np.array([0]))
        return max((bytes(kept) for kept in wire.captured), key=len)


@contextlib.contextmanager
def peers(server: Listening, count: int) -> Iterator[list[socket.socket]]:
    with contextlib.ExitStack() as stack:
        yield [stack.enter_context(knock(server.port)) for _ in range(count)]


def hello(noise: bytes) -> bytes:
    """A CURVE HELLO of the right form, whose box nobody has sealed."""
    body = b"\x05HELLO\x01\x00" + noise
    return b"\x04" + bytes([_HELLO_BYTES]) + body.ljust(_HELLO_BYTES, b"\0")[:_HELLO_BYTES]


def test_forged_hellos_are_refused_and_cost_nothing(server: Listening, good: Any) -> None:
    """Each makes the server compute; none makes it remember, or write a line each."""
    before, jails = server.memory(), server.open_jails()
    with peers(server, _PEERS) as connections:
        for connection in connections:
            say(connection, _CURVE_GREETING + hello(os.urandom(_HELLO_BYTES)))
        good.call("count")
        assert all(map(ends, connections))
    assert server.memory() - before < 64 * _MIB
    assert server.open_jails() <= jails


def test_replayed_beginnings_open_no_session(server: Listening, good: Any, captured: bytes) -> None:
    """A true HELLO is answered, as it must be; what follows fits no connection but its own."""
    before, jails = server.sessions(), server.open_jails()
    lengths = [*range(1, 600, 23), len(captured) // 2, len(captured)]
    with peers(server, len(lengths) * 3) as connections:
        for connection, length in zip(connections, lengths * 3, strict=True):
            say(connection, captured[:length])
        good.call("count")
        assert all(map(ends, connections))
    after = server.sessions()
    assert {one["session"] for one in after} <= {one["session"] for one in before}
    assert server.open_jails() <= jails


def test_dripping_strangers_are_shown_the_door(server: Listening, good: Any) -> None:
    """Who does not finish a handshake in a few seconds; who sends a byte now and then is never
    silent, and still has to be done in time."""
    with peers(server, 100) as silent:  # in the middle of a handshake
        for connection in silent:
            say(connection, _CURVE_GREETING[:3])
        good.call("count")
        assert all(map(ends, silent))
    with peers(server, 30) as connections:
        gone: set[int] = set()
        # never a whole greeting, which would be judged
        bytes_left = iter(_CURVE_GREETING[:-1])

        def all_gone() -> bool:
            piece = bytes([next(bytes_left)]) if len(gone) < len(connections) else b""
            for number, connection in enumerate(connections):
                try:
                    connection.sendall(piece)
                    connection.settimeout(0.001)
                    if not connection.recv(1 << 16):
                        gone.add(number)
                except TimeoutError:
                    pass
                except OSError:
                    gone.add(number)
            return len(gone) == len(connections)

        good.call("count")
        while not all_gone():
            time.sleep(0.5)
