"""What runs below this process, and what is left of it."""

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import psutil


def descendants() -> set[int]:
    """Pids of every live process below this one; zombies do not count.
    Nor does what ``multiprocessing`` has started for this very process, for a test that compared
    with Gymnasium's ``AsyncVectorEnv``: it stays as long as we do."""
    below: set[int] = set()
    for child in psutil.Process().children():
        if _alive(child) and not _is_multiprocessings(child):
            below.add(child.pid)
            with contextlib.suppress(psutil.NoSuchProcess):
                below.update(one.pid for one in child.children(recursive=True) if _alive(one))
    return below


def open_descriptors(path: Path) -> int:
    """How many descriptors of ours are of a file; those of other threads come and go meanwhile."""
    links = []
    for descriptor in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # the one that is read by, or another thread's
            links.append(descriptor.readlink())
    return links.count(path)


@contextlib.contextmanager
def halted(pids: Iterable[int]) -> Iterator[None]:
    """Processes are stopped meanwhile: what is asked of them is late, whoever is slow just now."""
    held = list(pids)
    try:
        for pid in held:
            os.kill(pid, signal.SIGSTOP)
        assert eventually(lambda: all(is_stopped(pid) for pid in held))
        yield
    finally:
        for pid in held:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)


def other_niceness() -> int:
    """The lowest priority that this process does not have itself, however it was started.
    Only root may raise a priority, where the run has the lowest one."""
    return 19 if os.nice(0) < 19 else 18


def may_change_niceness() -> bool:
    return os.nice(0) < 19 or os.geteuid() == 0


def resident() -> dict[int, int]:
    """Bytes of memory of this process and of each of its children, by pid."""
    found = {}
    for process in (psutil.Process(), *psutil.Process().children()):
        with contextlib.suppress(psutil.NoSuchProcess):
            found[process.pid] = int(process.memory_info().rss)
    return found


def most_grown(before: dict[int, int]) -> int:
    """By how many bytes the one of these has grown that has grown most.
    Who has ended since does not count: a server of earlier tests may linger, and its time come."""
    now = resident()
    return max(now[pid] - bytes_ for pid, bytes_ in before.items() if pid in now)


@contextlib.contextmanager
def unless_ended(pid: int) -> Iterator[None]:
    """What is asked of a process that may end meanwhile is left unanswered once it has.
    As long as nobody has asked for its end, its entry in ``/proc`` is there, and is root's: a plain
    user is refused what was his a moment ago."""
    try:
        yield
    except (FileNotFoundError, ProcessLookupError):
        return
    except PermissionError:
        with contextlib.suppress(psutil.NoSuchProcess):
            if psutil.Process(pid).status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD):
                raise


def is_stopped(pid: int) -> bool:
    return bool(psutil.Process(pid).status() == psutil.STATUS_STOPPED)


def eventually(claim: Callable[[], bool], deadline_s: float = 90.0) -> bool:
    """Whether a claim comes true before a generous deadline."""
    end = time.monotonic() + deadline_s
    while not claim():
        if time.monotonic() > end:
            return False
        time.sleep(0.05)
    return True


def _is_multiprocessings(process: psutil.Process) -> bool:
    try:
        words = " ".join(process.cmdline())
    except psutil.Error:
        return False
    return "multiprocessing.resource_tracker" in words or "multiprocessing.forkserver" in words


def _alive(process: psutil.Process) -> bool:
    try:
        return bool(process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False
