"""Turns: what concerns the whole machine is done by one test at a time, whichever run it is of."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager

_PLACES = {"broadcasting": "/usr", "memory": "/usr/bin", "quotas": "/usr/lib"}
"""What is locked for each: a folder that is there, that every user may read, and that nobody else
locks. A file of the checkout would do for one run; a machine may have several, of several users.
"""
LONGEST_S = 600
"""A test that may wait for so long has a timeout to match."""


@contextmanager
def turn(name: str) -> Iterator[None]:
    """While it lasts no other process of this machine has this turn; who waits has it in turn."""
    place = os.open(_PLACES[name], os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(place, fcntl.LOCK_EX)
        yield
    finally:
        fcntl.flock(place, fcntl.LOCK_UN)  # a child that was forked meanwhile has it open, too
        os.close(place)
