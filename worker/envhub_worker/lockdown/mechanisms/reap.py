"""Ends every process below this one if no pid namespace does so."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import time
from collections.abc import Callable, Collection, Iterator

from envhub_worker.lockdown.mechanisms.procfs import descendants

PATIENCE_S = 5.0
"""How long to wait for killed processes; one that waits in the kernel ends later."""
_PAUSE_S = 0.001

#: The signals that ``child_signals`` sets handlers for.
HANDLED = (signal.SIGCHLD, signal.SIGTERM)


def _nothing(*_: object) -> None:
    pass


def child_signals(stop: Callable[..., None]) -> int:
    """Returns a descriptor that is readable when a child changes state or SIGTERM comes."""
    read, write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.signal(signal.SIGCHLD, _nothing)  # ignored, it would not wake
    signal.signal(signal.SIGTERM, stop)
    signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    return read


def drain(fd: int) -> None:
    """Read and drop everything in the non-blocking ``fd``."""
    with contextlib.suppress(BlockingIOError):
        while os.read(fd, 4096):
            pass


def reap(before: Callable[[int], None] = _nothing) -> Iterator[tuple[int, int]]:
    """Reaps every ended child, adopted orphans included; returns pids and wait statuses.
    ``before``: called with each pid while that still belongs to the dead child.
    """
    with contextlib.suppress(ChildProcessError):
        while ended := os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            before(ended.si_pid)
            yield os.waitpid(ended.si_pid, 0)


def kill_descendants(keep: Collection[int] = (), root: int | None = None) -> None:
    """SIGKILL everything below ``root`` (default: this process), daemons and fork bombs included.

    All are stopped before any is killed, until no new process appears: a stopped process cannot
    fork. But a process that is stopped inside ``fork`` may complete it, and its child can appear
    after the last look. So this function ends with a look that finds only processes that had ended
    before it began: a live process would have a parent that this look would find. ``root`` must
    adopt the orphans of its descendants. On a slow machine new processes are killed, too: a stopped
    process counts as one, so the limit on processes bounds how many appear.
    """
    root = os.getpid() if root is None else root
    deadline = 0.0
    killed: set[int] = set()
    ended: set[int] = set()
    while not ended.issuperset(descendants(root, keep)):
        stopped = _stop_below(root, keep)
        _signal(stopped, signal.SIGKILL)
        if stopped - killed:
            deadline = time.monotonic() + PATIENCE_S
        elif time.monotonic() > deadline:
            return
        killed = stopped
        time.sleep(_PAUSE_S)
        ended = {pid for pid in stopped if _has_ended(pid)}


def _stop_below(root: int, keep: Collection[int]) -> set[int]:
    stopped: set[int] = set()
    while new := set(descendants(root, keep)) - stopped:
        _signal(new, signal.SIGSTOP)
        stopped |= new
    return stopped


def _has_ended(pid: int) -> bool:
    """Whether every thread has ended: ``/proc`` shows a zombie once the first thread has ended."""
    try:
        pidfd = os.pidfd_open(pid)
    except OSError as error:
        return isinstance(error, ProcessLookupError)
    try:
        poller = select.poll()
        poller.register(pidfd, select.POLLIN)
        return bool(poller.poll(0))
    finally:
        os.close(pidfd)


def _signal(pids: Collection[int], signum: int) -> None:
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signum)
