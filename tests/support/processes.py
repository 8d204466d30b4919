"""What runs below this process, and what is left of it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

import psutil


def descendants() -> set[int]:
    """Pids of every live process below this one; zombies do not count.

    Nor does what ``multiprocessing`` has started for this very process, for a test that compared
    with Gymnasium's ``AsyncVectorEnv``: it stays as long as we do.
    """
    below: set[int] = set()
    for child in psutil.Process().children():
        if _alive(child) and not _is_multiprocessings(child):
            below.add(child.pid)
            with contextlib.suppress(psutil.NoSuchProcess):
                below.update(one.pid for one in child.children(recursive=True) if _alive(one))
    return below


def eventually(claim: Callable[[], bool], deadline_s: float = 90.0) -> bool:
    """Whether a claim comes true before a generous deadline."""
    end = time.monotonic() + deadline_s
    while not claim():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


def _is_multiprocessings(process: psutil.Process) -> bool:
    try:
        words = " ".join(process.cmdline())
    except psutil.Error:
        return False
    return "multiprocessing.resource_tracker" in words or "multiprocessing.forkserver" in words


def _alive(process: psutil.Process) -> bool:
    try:
        return bool(process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False
