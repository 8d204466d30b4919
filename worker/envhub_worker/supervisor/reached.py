"""Which of its limits a jail has come to, by what the kernel and its file system say right now.

From outside of it: what has been used up is what a jail is denied from then on, and nobody need
take its word for that.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Iterator, Mapping

from envhub_worker.lockdown.root_plan import TEMPORARY
from envhub_worker.protocol.confinement import Limits
from envhub_worker.supervisor.usage import descriptors

_LEFT_BYTES = 1 << 16
"""Below that a scratch is full: it is counted in pages, and for each core."""


def reached(
    limits: Limits, usage: Mapping[str, int], runners: Collection[int], *, own_root: bool
) -> Iterator[str]:
    """The names of limits that are used up.

    Args:
        usage: What it holds; empty where nobody has counted.
        own_root: Whether its scratch is a file system of its own.
    """
    if usage and usage["processes"] + usage["threads"] >= limits.processes:
        yield "PROCESSES"
    if any(descriptors(pid) >= limits.open_files - 1 for pid in runners):  # a pipe takes two
        yield "OPEN_FILES"
    for pid in runners if own_root else ():
        with contextlib.suppress(OSError):
            left = os.statvfs(f"/proc/{pid}/root{TEMPORARY}")
            yield from _used_up(left)
            return


def _used_up(left: os.statvfs_result) -> Iterator[str]:
    if left.f_bavail * left.f_frsize < _LEFT_BYTES:
        yield "DISK_BYTES"
    if left.f_ffree == 0:
        yield "DISK_FILES"
