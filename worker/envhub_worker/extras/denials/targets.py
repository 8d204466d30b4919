"""Decides whether a system call targets a process outside of the caller's jail."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence

from envhub_worker.lockdown.mechanisms import procfs
from envhub_worker.lockdown.seccomp.syscalls import NAMING, SIGNUM, WHICH

#: The detail of a call that names another process.
OTHER = "OTHER_PROCESS"

_FIRST = 1
_ENTRY = re.compile(r"/proc/(\d{1,18})(/.*)?", re.DOTALL)


def is_another_target(call: str, arguments: Sequence[int], caller: int, init: int) -> bool:
    """Whether a call of ``NAMING`` targets a process outside of the jail, such as the jail's init.
    ``arguments``: the first three, as C integers.
    """
    if call in WHICH and arguments[0] != WHICH[call]:
        return False
    if call in SIGNUM and arguments[SIGNUM[call]] == 0:
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
    """Whether a path is below ``/proc/N`` of a process that the jail cannot know."""
    entry = _ENTRY.fullmatch(path)
    return entry is not None and _never_was(int(entry[1]))


def _never_was(number: int) -> bool:
    """Whether no process can have had this number.

    In a pid namespace of the jail's own: it is above the last number given out there. On the host,
    where numbers begin again at low ones: it is above the largest possible one.
    """
    is_ours = os.getpid() == _FIRST
    most = procfs.text("/proc/loadavg" if is_ours else "/proc/sys/kernel/pid_max")
    return most is not None and number > int(most.split()[-1])
