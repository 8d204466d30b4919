"""What runs below this process, and what is left of it."""

from __future__ import annotations

import time
from collections.abc import Callable

import psutil


def descendants() -> set[int]:
    """Pids of every live process below this one; zombies do not count."""
    children = psutil.Process().children(recursive=True)
    return {child.pid for child in children if _alive(child)}


def eventually(claim: Callable[[], bool], deadline_s: float = 90.0) -> bool:
    """Whether a claim comes true before a generous deadline."""
    end = time.monotonic() + deadline_s
    while not claim():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


def _alive(process: psutil.Process) -> bool:
    try:
        return bool(process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False
