"""Two busy processes that nobody asked for, and what else the machine is doing."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil

_QUIET_CORES = 0.15
_POLL_S = 0.2
_BUSY = "import os\nparent = os.getppid()\nwhile os.getppid() == parent:\n    sum(range(100000))"


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Keep ``count`` processes computing; they end with us."""
    busy = [sys.executable, "-I", "-c", _BUSY]
    others = [subprocess.Popen(busy, start_new_session=True) for _ in range(count)]
    for other in others:
        take_precedence(other.pid)
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def take_precedence(pid: int) -> None:
    """Extend our own niceness to the sessions of a process and its descendants.

    With ``sched_autogroup`` the niceness of processes counts only within their session.
    """
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    if not nice:
        return
    process = psutil.Process(pid)
    for member in [process, *process.children(recursive=True)]:
        with suppress(OSError):
            Path(f"/proc/{member.pid}/autogroup").write_text(str(nice))


def load_average() -> float:
    """Processes that ran or wanted to, over the last minute."""
    return os.getloadavg()[0]


def busy_cores(seconds: float = 0.1) -> float:
    """Cores that are in use. Called while all peers are parked, so by somebody else."""
    before = _jiffies()
    time.sleep(seconds)
    return (_jiffies() - before) / os.sysconf("SC_CLK_TCK") / seconds


class Patience:
    """Waits for others to leave the machine alone, but not forever.

    Args:
        total_s: Seconds to spend on it altogether.
    """

    def __init__(self, total_s: float) -> None:
        self._left_s = total_s

    def wait(self) -> float:
        """Wait until nobody else computes, or patience ends; returns the cores then in use."""
        busy = busy_cores()
        while busy > _QUIET_CORES and self._left_s > 0:
            start = time.monotonic()
            time.sleep(_POLL_S)
            busy = busy_cores()
            self._left_s -= time.monotonic() - start
        return round(busy, 2)


def stolen() -> tuple[int, int]:
    """Jiffies that the host took, and all of them."""
    cpu = Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]
    return int(cpu[7]), sum(map(int, cpu))


def _jiffies() -> int:
    # user, nice, system, idle, iowait, irq, softirq, steal: see proc_stat(5)
    with open("/proc/stat") as stat:
        fields = [int(field) for field in stat.readline().split()[1:9]]
    return sum(fields) - fields[3] - fields[4]
