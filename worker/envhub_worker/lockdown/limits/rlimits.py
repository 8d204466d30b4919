"""Resource limits of one process of a jail."""

from __future__ import annotations

import resource
from collections.abc import Mapping

from envhub_worker.protocol.confinement import Limits

# Signals in the queue and armed timers: the kernel counts them per user, and answers the user's
# other programs EAGAIN at their own limit, some tens of thousands.
_SIGNALS = 512

# The kernel sends SIGXCPU at the soft limit and SIGKILL at the hard one; the second in between
# lets the process print where it was.
_CPU_GRACE_S = 1


def wanted(limits: Limits, processes: int | None) -> dict[int, tuple[int, int]]:
    """Resource number to (soft, hard).

    Args:
        processes: Cap for ``RLIMIT_NPROC``, or None where it would count strangers.
    """
    file_bytes = limits.disk_bytes if limits.file_bytes is None else limits.file_bytes
    rules = {
        resource.RLIMIT_CORE: (0, 0),
        resource.RLIMIT_FSIZE: (file_bytes, file_bytes),
        resource.RLIMIT_NOFILE: (limits.open_files, limits.open_files),
        resource.RLIMIT_MEMLOCK: (64 * 1024, 64 * 1024),
        resource.RLIMIT_MSGQUEUE: (0, 0),
        resource.RLIMIT_NICE: (0, 0),
        resource.RLIMIT_SIGPENDING: (_SIGNALS, _SIGNALS),
        resource.RLIMIT_RTPRIO: (0, 0),
    }
    if processes is not None:
        rules[resource.RLIMIT_NPROC] = (processes, processes)
    if limits.cpu_s is not None:
        rules[resource.RLIMIT_CPU] = (limits.cpu_s, limits.cpu_s + _CPU_GRACE_S)
    return rules


def apply(rules: Mapping[int, tuple[int, int]]) -> None:
    """Set each limit, never above the hard limit that already holds."""
    for number, (soft, hard) in rules.items():
        ceiling = resource.getrlimit(number)[1]
        if ceiling != resource.RLIM_INFINITY:
            soft, hard = min(soft, ceiling), min(hard, ceiling)
        resource.setrlimit(number, (soft, hard))
