"""Processes of ours: whose this is, one that ends with its parent, whether a child has ended.

``OwnerProcess`` is docs/internals/interruption.md, rule 14.

A parent hands its child a pidfd of itself, which the child watches, or on macOS a pipe that ends
with it. The kernel's own signal at a parent's death would come when the thread ends that started
the child, and a change of user forgets it. Windows hands no descriptors on, and has none of this.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from envhub_sandbox.system.platform import IS_LINUX, run_after_fork

_STREAMS = 3
_pipe: list[int] = []
"""Of a process without a pidfd of itself: both ends, of which it alone has the second."""


class OwnerProcess:
    """The process that made this.
    ``pid``: its number. Where each step asks, this is compared without a call.
    """

    def __init__(self) -> None:
        self.pid = os.getpid()

    @property
    def is_here(self) -> bool:
        """Whether it is this one, and no fork of it."""
        return os.getpid() == self.pid


def fork_error_text(owner: int | None = None) -> str:
    """The text of the error of an environment that is used in a fork of its owner."""
    whose = "this environment belongs to another process"
    if owner is not None:
        whose = f"this environment belongs to process {owner}"
    return f"{whose}, and this is a fork of it ({os.getpid()}); call make_env in this process"


@contextlib.contextmanager
def pidfd() -> Iterator[int]:
    """A pidfd of this process, for one that is started meanwhile with it in ``pass_fds``.

    Where there are none it is a pipe, of which the end comes with that of this process.
    """
    if sys.platform == "linux":
        ourselves = os.pidfd_open(os.getpid())
        try:
            yield ourselves
        finally:
            os.close(ourselves)
    else:
        _pipe[:] = _pipe or os.pipe()
        yield _pipe[0]


def _forget_pipe() -> None:
    """A fork would keep it open, and is told of its own by another."""
    while _pipe:
        os.close(_pipe.pop())


if not IS_LINUX:
    run_after_fork(_forget_pipe)


def end_with(parent: int, patience_s: float) -> None:
    """End this process as soon as another has ended, and with it the group that it leads.
    ``parent``: a pidfd of the other.
    ``patience_s``: for what SIGTERM does here, in the main thread, before all are killed; with none
    they are killed at once.
    """
    os.set_inheritable(parent, False)
    threading.Thread(target=_watch, args=(parent, patience_s), daemon=True).start()


def _watch(parent: int, patience_s: float) -> None:
    if sys.platform != "win32":
        poll = select.poll()  # of descriptors beyond 1023, too
        poll.register(parent, select.POLLIN)
        while not poll.poll():
            pass
        if patience_s > 0:
            # of all threads the one whose system call it has to interrupt
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
            time.sleep(patience_s)
        if os.getpgrp() == os.getpid():
            os.killpg(0, signal.SIGKILL)
        os.kill(os.getpid(), signal.SIGKILL)


def has_ended(pid: int) -> bool:
    """Whether a child has ended, reaped or not. It is a zombie before its threads are gone."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text("utf-8", "replace")
    except OSError:
        return True
    # the command may hold anything, parentheses and blanks included
    return stat.rpartition(")")[2].split()[0] in "ZX"


def occupy_streams() -> None:
    """Take the numbers 0, 1 and 2, where a program was started without them: ``<&- >&- 2>&-``.

    Else our first sockets and pipes would have them: what anybody prints would go to a worker, and
    what a worker is handed would be closed there in favour of its own standard streams.
    """
    while (null := os.open(os.devnull, os.O_RDWR)) < _STREAMS:  # the lowest that is free
        os.set_inheritable(null, True)
    os.close(null)


def replace_missing_streams() -> None:
    """Occupy the numbers, and let ``print`` and others find a stream: for a program of ours."""
    occupy_streams()
    sys.stdin = sys.stdin or open(os.devnull)  # noqa: SIM115
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
