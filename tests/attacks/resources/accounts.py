"""What the kernel counts of a run's processes."""

import contextlib
import fcntl
import os
import termios
from array import array
from pathlib import Path

from tests.attacks.harness import Run


def tasks(run: Run) -> int:
    """Live threads of all processes of a run."""
    count = 0
    for pid in run.pids():
        with contextlib.suppress(OSError):
            count += len(os.listdir(f"/proc/{pid}/task"))
    return count


def of_processes(run: Run, name: str, file: str = "smaps_rollup") -> int:
    """A figure of the kernel's about each process of a run, added up."""
    return sum(figure(f"/proc/{pid}/{file}", name) for pid in run.pids())


def figure(path: str, name: str) -> int:
    """One line of ``name: 123 kB``, in bytes; 0 where a process has ended."""
    with contextlib.suppress(OSError):
        for line in Path(path).read_text().splitlines():
            if line.startswith(f"{name}:"):
                return int(line.split()[1]) * 1024
    return 0


def terminals(run: Run) -> int:
    links = [
        os.readlink(f"/proc/{pid}/fd/{fd}")
        for pid in run.pids()
        for fd in os.listdir(f"/proc/{pid}/fd")
    ]
    return sum(link.endswith("/ptmx") for link in links)


def in_pipes(run: Run) -> int:
    held = {}
    for pid in run.pids():
        with contextlib.suppress(OSError):
            for fd in os.listdir(f"/proc/{pid}/fd"):
                path = f"/proc/{pid}/fd/{fd}"
                if os.readlink(path).startswith("pipe:"):
                    held[os.readlink(path)] = waiting(path)
    return sum(held.values())


def waiting(path: str) -> int:
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        words = array("i", [0])
        fcntl.ioctl(fd, termios.FIONREAD, words)
        return words[0]
    finally:
        os.close(fd)
