"""What a jail holds of this machine right now, counted from outside: by what the kernel says."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Collection
from time import monotonic

from envhub_worker.lockdown.mechanisms import reap

_KIB = 1024
_AT_ONCE = 64
_A_SECOND = 16


class Counting:
    """How often is counted for whoever asks: each time takes the server's one thread some ms."""

    def __init__(self, now: Callable[[], float] = monotonic) -> None:
        self._now = now
        self._left = float(_AT_ONCE)
        self._seen = now()

    def children(self) -> reap.Children | None:
        """Who is below whom on this machine; None for whoever asks too often."""
        now = self._now()
        self._left = min(_AT_ONCE, self._left + (now - self._seen) * _A_SECOND)
        self._seen = now
        if self._left < 1:
            return None
        self._left -= 1
        return reap.all_children()


def usage_of(init: int, runners: Collection[int], children: reap.Children) -> dict[str, int]:
    """Processes, threads and memory of a jail; empty where it has gone, or has not begun.

    Args:
        init: The pid of its first process, which adopts whatever is orphaned in it.

    Returns:
        ``processes``: all that live or wait to be reaped, without init. ``threads``: theirs, beyond
        one each. ``files``: descriptors that the runners have open. ``memory_bytes``: of the
        runners, what is theirs alone and not a file's.
    """
    if init <= 0:
        return {}
    processes = reap.descendants(init, children=children)
    fields = {pid: _fields(pid) for pid in {*processes, *runners}}
    threads = sum(max(fields[pid].get("Threads", 1), 1) - 1 for pid in processes)
    kib = sum(fields[pid].get(name, 0) for pid in runners for name in ("RssAnon", "VmSwap"))
    files = sum(map(descriptors, runners))
    return {
        "processes": len(processes),
        "threads": threads,
        "files": files,
        "memory_bytes": _KIB * kib,
    }


def descriptors(pid: int) -> int:
    """How many files a process has open; 0 where it has gone, or may not be looked at."""
    with contextlib.suppress(OSError):
        return len(os.listdir(f"/proc/{pid}/fd"))
    return 0


def _fields(pid: int) -> dict[str, int]:
    """The numbers of ``/proc/PID/status``; none of a process that has gone."""
    try:
        with open(f"/proc/{pid}/status", encoding="utf-8", errors="replace") as file:
            lines = file.read().splitlines()
    except OSError:
        return {}
    words = (line.split() for line in lines)
    return {row[0].rstrip(":"): int(row[1]) for row in words if len(row) > 1 and row[1].isdecimal()}
