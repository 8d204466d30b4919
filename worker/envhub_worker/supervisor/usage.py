"""What a jail holds of this machine, and which of its limits it has come to.

Counted from outside: by what the kernel and its file system say right now. What is used up is
denied to the jail from then on, and nothing that the jail says is needed to know it.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Collection, Iterator, Mapping
from time import monotonic

from envhub_worker.lockdown.mechanisms import procfs
from envhub_worker.lockdown.root_plan import TEMPORARY
from envhub_worker.protocol.confinement import Limits

_AT_ONCE = 64
_A_SECOND = 16
_LEFT_BYTES = 1 << 16
"""A scratch with less counts as full: the kernel counts pages, and keeps some per core."""


class CountLimit:
    """Bounds how often is counted: each time takes the server's one thread some milliseconds."""

    def __init__(self, now: Callable[[], float] = monotonic) -> None:
        self._now = now
        self._left = float(_AT_ONCE)
        self._seen = now()

    def children(self) -> procfs.Children | None:
        """The children of each process on this machine; None where it was asked too often."""
        now = self._now()
        self._left = min(_AT_ONCE, self._left + (now - self._seen) * _A_SECOND)
        self._seen = now
        if self._left < 1:
            return None
        self._left -= 1
        return procfs.all_children()


def usage_of(init: int, runners: Collection[int], children: procfs.Children) -> dict[str, int]:
    """Processes, threads and memory of the jail of ``init``; empty where it has gone, or has not
    begun.

    ``processes``: all that live or wait to be reaped, without init. ``threads``: theirs, beyond
    one each. ``files``: descriptors that the runners have open. ``memory_bytes``: of the runners,
    what is theirs alone and not a file's.
    """
    if init <= 0:
        return {}
    processes = procfs.descendants(init, children=children)
    fields = {pid: _status(pid) for pid in {*processes, *runners}}
    held = (fields[pid].get(name, 0) for pid in runners for name in (b"RssAnon", b"VmSwap"))
    return {
        "processes": len(processes),
        "threads": sum(max(fields[pid].get(b"Threads", 1), 1) - 1 for pid in processes),
        "files": sum(map(procfs.descriptors, runners)),
        "memory_bytes": sum(held),
    }


def _status(pid: int) -> dict[bytes, int]:
    with contextlib.suppress(OSError):
        return procfs.numbers(f"/proc/{pid}/status")
    return {}


def reached(
    limits: Limits, usage: Mapping[str, int], runners: Collection[int], *, own_root: bool
) -> Iterator[str]:
    """The names of limits that are used up.
    ``usage``: of ``usage_of``; ``own_root``: whether its scratch is a file system of its own.
    """
    if usage and usage["processes"] + usage["threads"] >= limits.processes:
        yield "PROCESSES"
    if any(procfs.descriptors(pid) >= limits.open_files - 1 for pid in runners):  # a pipe takes two
        yield "OPEN_FILES"
    for pid in runners if own_root else ():
        with contextlib.suppress(OSError):
            left = os.statvfs(f"/proc/{pid}/root{TEMPORARY}")
            if left.f_bavail * left.f_frsize < _LEFT_BYTES:
                yield "DISK_BYTES"
            if left.f_ffree == 0:
                yield "DISK_FILES"
            return
