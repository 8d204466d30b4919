"""Turns: what concerns the whole machine is done by one test at a time, whichever run it is of."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
from collections.abc import Iterator

from tests.support.processes import eventually

LONGEST_S = 600.0
"""A test that may wait for so long has a timeout to match."""


@contextlib.contextmanager
def turn(name: str) -> Iterator[None]:
    """While it lasts no other process of this machine has the turn of this name.

    A lock of a file in the checkout would hold for one run of the tests, and the machine may have
    several, of several users. This is a name that the kernel gives to one socket at a time, and
    takes back however its process ends.
    """
    with socket.socket(socket.AF_UNIX) as held:

        def taken() -> bool:
            try:
                held.bind(f"\0envhub-test-turn-{name}")
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise
                return False
            return True

        assert eventually(taken, LONGEST_S), f"the turn {name!r} did not come"
        yield


@contextlib.contextmanager
def turn_of_user(name: str) -> Iterator[None]:
    """The same for one user's tests: what the kernel counts for each user."""
    with turn(f"{name}-{os.geteuid()}"):
        yield
