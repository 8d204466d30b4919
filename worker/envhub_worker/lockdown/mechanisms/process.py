"""Settings of the calling process: signal at its parent's death, descriptors, privileges.

All capabilities are dropped: with a single one a jail could remount /usr writable.
"""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import signal
from collections.abc import Iterable, Mapping

from envhub_worker.lockdown.mechanisms import kernel

_PR_SET_PDEATHSIG = 1
_PR_SET_DUMPABLE = 4
_PR_SET_CHILD_SUBREAPER = 36
_PR_SET_NO_NEW_PRIVS = 38
_PR_GET_NO_NEW_PRIVS = 39
_PR_CAPBSET_DROP = 24
_PR_CAP_AMBIENT, _PR_CAP_AMBIENT_CLEAR_ALL = 47, 4
_CAP_SETPCAP = 8

_LAST_FD = 2**31 - 1
_MAX_OPEN_FILES = 65_536


def raise_file_limit() -> None:
    """Raise the limit of open files to the hard limit: a server needs some for each runner."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _MAX_OPEN_FILES if hard == resource.RLIM_INFINITY else min(hard, _MAX_OPEN_FILES)
    if 0 <= soft < wanted:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def die_with_parent(parent: int, signum: int = signal.SIGKILL) -> None:
    """Receive ``signum`` when the parent thread ends; ``parent`` is its pid as we see it.

    A change of user clears this setting: call again after each. A parent that has ended before the
    call sends nothing, so this function checks for it afterwards.
    """
    kernel.prctl(_PR_SET_PDEATHSIG, signum)
    if os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)


def set_dumpable(dumpable: bool) -> None:
    """Say whether same-user processes may trace this one and read its memory."""
    kernel.prctl(_PR_SET_DUMPABLE, int(dumpable))


def become_subreaper() -> None:
    """Adopt the orphans among our descendants."""
    kernel.prctl(_PR_SET_CHILD_SUBREAPER, 1)


def set_no_new_privileges() -> None:
    """Keep every later ``execve`` from gaining privileges by set-user-id or file capabilities."""
    kernel.prctl(_PR_SET_NO_NEW_PRIVS, 1)


def has_no_new_privileges() -> bool:
    """Whether ``set_no_new_privileges`` holds for this thread."""
    return kernel.prctl(_PR_GET_NO_NEW_PRIVS) == 1


def drop_capabilities() -> None:
    """Empty the bounding, ambient, inheritable, permitted and effective sets."""
    # Before the others: emptying the permitted set also takes the right to change the bounding set.
    empty_the_bounding_set()
    kernel.prctl(_PR_CAP_AMBIENT, _PR_CAP_AMBIENT_CLEAR_ALL)
    kernel.capset_none()


def held_capabilities() -> int:
    """Returns the mask of all capabilities that this thread has, may have or may pass on."""
    effective, permitted, inheritable = kernel.capget()
    return effective | permitted | inheritable


def empty_the_bounding_set() -> None:
    """Keep every later ``execve`` from adding capabilities. Does nothing without CAP_SETPCAP."""
    if not kernel.capget()[0] >> _CAP_SETPCAP & 1:
        return
    for capability in range(64):
        try:
            kernel.prctl(_PR_CAPBSET_DROP, capability)
        except OSError as error:
            if error.errno != errno.EINVAL:
                raise
            return  # the first that this kernel does not know


def apply_limits(rules: Mapping[int, tuple[int, int]]) -> None:
    """Set the (soft, hard) limits of each resource, never above the present hard limit."""
    for number, (soft, hard) in rules.items():
        ceiling = resource.getrlimit(number)[1]
        if ceiling != resource.RLIM_INFINITY:
            soft, hard = min(soft, ceiling), min(hard, ceiling)
        resource.setrlimit(number, (soft, hard))


def close_all_but(keep: Iterable[int]) -> None:
    """Close every descriptor that is not in ``keep``."""
    low = 0
    for fd in sorted(set(keep)):
        if fd > low:
            _close_range(low, fd - 1)
        low = fd + 1
    _close_range(low, _LAST_FD)


def _close_range(low: int, high: int) -> None:
    try:
        kernel.syscall("close_range", low, high, 0)
    except OSError as error:
        if error.errno != errno.ENOSYS:
            raise
        for fd in [int(name) for name in os.listdir("/proc/self/fd")]:
            if low <= fd <= high:
                os.closerange(fd, fd + 1)


def reset_signals(handled: Iterable[int]) -> None:
    """Set dispositions and mask to those of a Python program after a plain exec.
    ``handled``: the signals that this program has set a handler for. (To ask for all 64 costs more
    than the rest of a fork.)
    """
    signal.set_wakeup_fd(-1)
    for signum in handled:
        signal.signal(signum, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())


def pid_of(pidfd: int) -> int:
    """Returns the pid of ``pidfd`` as this process sees it; 0 or less after its end."""
    with open(f"/proc/self/fdinfo/{pidfd}") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("Pid:"))


def exit_fields(status: int) -> dict[str, int | None]:
    """Returns ``{"code", "signal"}`` of a wait status; exactly one of the two is not None."""
    code = os.waitstatus_to_exitcode(status)
    return {"code": code, "signal": None} if code >= 0 else {"code": None, "signal": -code}
