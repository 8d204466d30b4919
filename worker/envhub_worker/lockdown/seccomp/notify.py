"""Init answers the calls that the filter hands to it: signals, and recorded calls.

In a jail without a pid namespace, where Landlock cannot scope signals (before ABI 6), the filter
hands ``kill``, ``tkill`` and ``tgkill`` to init, which sends the signal if the target is a process
of the jail; and ``setpgid``, since init has the session of all runners, and a process in its group
could signal it with that group. Their arguments are numbers in registers, so none can change
between check and use.
Init opens a pidfd of the target before it checks it, so no other process can take over the pid. The
kernel itself delivers signals of a process to itself: a signal from init would interrupt the very
call that waits for init's answer.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import signal
import struct
from collections.abc import Callable, Collection
from functools import partial

from envhub_worker.lockdown.mechanisms import kernel, procfs
from envhub_worker.lockdown.seccomp.policy import BROKERED, WITHOUT_ATTRIBUTES, refusal
from envhub_worker.lockdown.seccomp.syscalls import c_int, syscall_name
from envhub_worker.protocol.records import dataclass

_RECEIVE = 0xC0502100  # SECCOMP_IOCTL_NOTIF_RECV
_SEND = 0xC0182101  # SECCOMP_IOCTL_NOTIF_SEND
_STILL_WAITS = 0x40082102  # SECCOMP_IOCTL_NOTIF_ID_VALID
_CONTINUE = 1  # SECCOMP_USER_NOTIF_FLAG_CONTINUE

# struct seccomp_notif: id, tid, flags, then struct seccomp_data: call, arch, address, arguments.
_REQUEST = struct.Struct("=QIIiIQ6Q")
# struct seccomp_notif_resp: id, value, error, flags.
_ANSWER = struct.Struct("=QqiI")


@dataclass(frozen=True)
class Request:
    """One system call that waits for an answer.

    Attributes:
        thread: The calling thread.
        caller: The thread's process; 0 if it has ended.
        call: The name of the system call.
        words: Its six arguments, as in the registers.
        still_waits: Raises OSError if the caller has ended since.
    """

    thread: int
    caller: int
    call: str
    words: tuple[int, ...]
    still_waits: Callable[[], object] = lambda: None

    @property
    def arguments(self) -> list[int]:
        """The first three arguments as C integers, as the kernel reads them."""
        return [c_int(word) for word in self.words[:3]]


_PROCEED = -1
"""In the place of an errno: the kernel makes the call itself. Not None, which is what a path would
answer that forgets to."""
_Inside = Callable[[], Collection[int]]


def serve(listener: int, permitted: Collection[str], note: Callable[[Request], None]) -> bool:
    """Answer one request that waits at ``listener``; returns False if no caller is left.

    The kernel continues the calls of ``permitted``, which the policy allows with any arguments and
    which init only records. All other calls except ``BROKERED`` are denied, and so are calls that
    set attributes.
    """
    buffer = bytearray(_REQUEST.size)
    try:
        fcntl.ioctl(listener, _RECEIVE, buffer)
    except OSError as error:
        # A signal took the caller out of its call; other callers may still come.
        return error.errno == errno.EINTR or _has_callers(listener)
    identity, thread, _, number, _, _, *words = _REQUEST.unpack(buffer)

    def still_waits() -> object:
        return fcntl.ioctl(listener, _STILL_WAITS, struct.pack("=Q", identity))

    call, caller = syscall_name(number), procfs.process_of(thread)
    request = Request(thread, caller, call, tuple(words), still_waits)
    note(request)  # before the caller goes on: what it did is known when it is looked for
    if call in permitted and call not in WITHOUT_ATTRIBUTES:
        answer = _PROCEED
    elif call in BROKERED:
        answer = decide(request, partial(procfs.descendants, os.getpid()))
    else:
        answer = refusal(call)
    result, flags = (0, _CONTINUE) if answer == _PROCEED else (-answer, 0)
    with contextlib.suppress(OSError):
        # The caller may have ended meanwhile: then nobody waits for an answer.
        fcntl.ioctl(listener, _SEND, _ANSWER.pack(identity, 0, result, flags))
    return True


def _has_callers(listener: int) -> bool:
    poller = select.poll()
    poller.register(listener, select.POLLIN)
    return not any(events & select.POLLHUP for _, events in poller.poll(0))


def decide(request: Request, inside: _Inside) -> int:
    """Decide on a call of ``BROKERED``, and send its signal if it is permitted. Returns 0, an
    errno, or ``_PROCEED``.
    ``inside``: returns the pids of the jail's processes, without init.
    """
    first, second, third = request.arguments
    if request.caller == 0:
        return errno.ESRCH
    if request.call == "setpgid":
        return errno.EPERM if second == os.getpgrp() else _PROCEED
    if request.call == "kill":
        return _kill(request.caller, first, second, inside)
    if request.call == "tkill":
        if first == request.thread:
            return _PROCEED
        return _send_to_thread(procfs.process_of(first), first, second, inside)
    if first == request.caller:
        return _PROCEED
    return _send_to_thread(first, second, third, inside)


def _kill(caller: int, target: int, signum: int, inside: _Inside) -> int:
    group = _group_of(caller)
    if group < 0:
        return errno.ESRCH  # it has gone since: no caller waits for the answer
    # A process group of a jail holds its processes only: it has its own session, and ``setpgid``
    # into init's group is denied.
    if target in (caller, 0, -group):
        return _PROCEED
    if target == -1:
        return errno.EPERM
    if target > 0:
        return _send(target, signum, inside)
    members = [pid for pid in inside() if _group_of(pid) == -target]
    return min((_send(pid, signum, inside) for pid in members), default=errno.ESRCH)


def _group_of(pid: int) -> int:
    with contextlib.suppress(ProcessLookupError):
        return os.getpgid(pid)
    return -1


def _send(pid: int, signum: int, inside: _Inside) -> int:
    return _held(pid, inside, lambda pidfd: signal.pidfd_send_signal(pidfd, signum))


def _send_to_thread(pid: int, thread: int, signum: int, inside: _Inside) -> int:
    if pid <= 0 or thread <= 0:
        return errno.ESRCH
    return _held(pid, inside, lambda _: kernel.syscall("tgkill", pid, thread, signum))


def _held(pid: int, inside: _Inside, act: Callable[[int], object]) -> int:
    """Call ``act`` with a pidfd of ``pid`` if that is in the jail. Returns 0 or an errno."""
    # In this order: the pidfd pins the pid to one process, and only then is it checked.
    try:
        pidfd = os.pidfd_open(pid)
    except OSError as error:
        return error.errno or errno.ESRCH
    try:
        if pid not in inside():
            return errno.EPERM
        act(pidfd)
    except OSError as error:
        return error.errno or errno.EPERM
    finally:
        os.close(pidfd)
    return 0
