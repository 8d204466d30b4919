"""Measures a jail's resources, and which of its limits are exhausted.

The server measures from outside, by the kernel and the file system, and needs no report from the
jail. An exhausted limit counts as a denial.
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
    """Limits how often processes are counted: a count takes the server's only thread some
    milliseconds.
    """

    def __init__(self, now: Callable[[], float] = monotonic) -> None:
        self._now = now
        self._left = float(_AT_ONCE)  # counts that may be made at once; refilled with time
        self._seen = now()  # when it was refilled last

    def children(self) -> procfs.Children | None:
        """Returns the children of each process on this machine; None if asked too often."""
        now = self._now()
        self._left = min(_AT_ONCE, self._left + (now - self._seen) * _A_SECOND)
        self._seen = now
        if self._left < 1:
            return None
        self._left -= 1
        return procfs.all_children()


def usage_of(init: int, runners: Collection[int], children: procfs.Children) -> dict[str, int]:
    """Returns processes, threads and memory of the jail of ``init``; empty before its start and
    after its end.

    ``processes``: all live and unreaped processes, without init. ``threads``: their threads beyond
    one each. ``files``: descriptors that the runners have open. ``memory_bytes``: the runners'
    private memory, without file pages.
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
    """Returns the names of exhausted limits.
    ``usage``: a result of ``usage_of``; ``own_root``: whether the scratch is its own file system.
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
