"""Which processes a waiting call is about, where it names one by its number.

The number stands in a register, so that it is what the kernel will read. What is seen decides
nothing: whether the call may reach that process is decided by the kernel, or by ``notify``.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence

from envhub_worker.lockdown.mechanisms import procfs

_PRETENDED = "sched_setscheduler sched_setparam sched_setattr sched_setaffinity"
_WHICH = {"setpriority": 0, "ioprio_set": 1}  # and what says there that a process is meant
_SIGNUM = {"kill": 1, "tkill": 1, "tgkill": 2, "rt_sigqueueinfo": 1, "rt_tgsigqueueinfo": 2}
#: What does nothing and says that it worked, where it is not permitted.
PRETENDED = frozenset(_PRETENDED.split())
#: Calls that name a process, and which of their arguments does.
NAMING = dict.fromkeys((*_SIGNUM, "pidfd_open", *PRETENDED), 0) | dict.fromkeys(_WHICH, 1)
#: The detail of a call that names another process.
OTHER = "OTHER_PROCESS"

_FIRST = 1
_ENTRY = re.compile(r"/proc/(\d{1,18})(/.*)?", re.DOTALL)


def is_another_target(call: str, arguments: Sequence[int], caller: int, init: int) -> bool:
    """Whether a call, one of ``NAMING``, is about a process outside of its jail, as its init is.
    ``arguments``: the first three, as C integers.
    """
    if call in _WHICH and arguments[0] != _WHICH[call]:
        return False
    if call in _SIGNUM and arguments[_SIGNUM[call]] == 0:
        return False  # it only looks whether somebody is there
    number = arguments[NAMING[call]]
    if call == "kill" and number < 0:
        return number == -1 or _never_was(-number)
    if number <= 0 or (call == "pidfd_open" and number == init):
        return False
    process = procfs.process_of(number)
    if process == 0:
        return _never_was(number)  # else it may have been a child's: then nothing is said of it
    return process == init or (process != caller and not procfs.is_below(process, init))


def never_a_target(path: str) -> bool:
    """Whether a path is below the entry of a process that the jail cannot have met."""
    entry = _ENTRY.fullmatch(path)
    return entry is not None and _never_was(int(entry[1]))


def _never_was(number: int) -> bool:
    """Whether a jail's own namespace has not yet come to that number, or no other can.

    A host begins again at low numbers, and a jail hardly ever lives that long.
    """
    is_ours = os.getpid() == _FIRST
    most = procfs.text("/proc/loadavg" if is_ours else "/proc/sys/kernel/pid_max")
    return most is not None and number > int(most.split()[-1])
