"""Ending every process below this one where no pid namespace does it for us."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

_ROUNDS_S = 5.0


#: The signals that ``child_signals`` sets handlers for.
HANDLED = (signal.SIGCHLD, signal.SIGTERM)


def child_signals(stop: Callable[..., None]) -> int:
    """A descriptor that becomes readable when a child changes state, or SIGTERM comes."""
    read, write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.signal(signal.SIGTERM, stop)
    signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    return read


def drain(fd: int) -> None:
    """Read whatever is in the non-blocking ``fd`` and drop it."""
    with contextlib.suppress(BlockingIOError):
        while os.read(fd, 4096):
            pass


def reap(before: Callable[[int], None] = lambda pid: None) -> Iterator[tuple[int, int]]:
    """The pid and wait status of every child that has ended; orphans we adopted included.

    Args:
        before: Is told the pid while that still belongs to the dead child.
    """
    with contextlib.suppress(ChildProcessError):
        while ended := os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            before(ended.si_pid)
            yield os.waitpid(ended.si_pid, 0)


Children = Mapping[int, Sequence[int]]
"""The children of every process that has some."""


def descendants(
    root: int, keep: Collection[int] = (), children: Children | None = None
) -> list[int]:
    """Pids below ``root``, without those in ``keep`` and what is below them.

    Args:
        children: What ``all_children`` gave a moment ago; looked up by default.
    """
    children = all_children() if children is None else children
    found: list[int] = []
    pending = [root]
    while pending:
        below = [pid for pid in children.get(pending.pop(), ()) if pid not in keep]
        found += below
        pending += below
    return found


def all_children() -> Children:
    """Who is below whom on this machine: takes some 0.1 ms for each process that there is."""
    children: dict[int, list[int]] = {}
    for name in os.listdir("/proc"):
        if name.isdigit():
            with contextlib.suppress(OSError):
                children.setdefault(_parent(int(name)), []).append(int(name))
    return children


def process_of(thread: int) -> int:
    """The pid of the process that ``thread`` belongs to; 0 when it has gone."""
    with contextlib.suppress(OSError), open(f"/proc/{thread}/status", "rb") as status:
        for line in status:
            if line.startswith(b"Tgid:"):
                return int(line.split()[1])
    return 0


def is_below(pid: int, root: int) -> bool:
    """Whether ``root`` is above ``pid``; so it is of one that goes meanwhile."""
    try:
        while pid > 1 and pid != root:
            pid = _parent(pid)
    except OSError:
        return True
    return pid == root


def _parent(pid: int) -> int:
    with open(f"/proc/{pid}/stat", "rb") as stat:
        # The command may hold anything, parentheses and blanks included.
        return int(stat.read().rpartition(b")")[2].split()[1])


def kill_descendants(keep: Collection[int]) -> None:
    """SIGKILL everything below this process but ``keep``, daemons and fork bombs included."""
    kill_below(os.getpid(), keep)


def kill_below(root: int, keep: Collection[int] = ()) -> None:
    """SIGKILL everything below ``root``.

    All are stopped first, until none is new: a stopped process cannot fork away. ``root`` must
    adopt the orphans of its descendants.
    """
    deadline = time.monotonic() + _ROUNDS_S
    stopped: set[int] = set()
    while time.monotonic() < deadline:
        new = [pid for pid in descendants(root, keep) if pid not in stopped]
        if not new:
            break
        _signal(new, signal.SIGSTOP)
        stopped.update(new)
    _signal(stopped, signal.SIGKILL)


def _signal(pids: Collection[int], signum: int) -> None:
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signum)
