"""What jails take of the processor and of memory, looked at now and then.

A thread of its own: reading ``/proc`` of many processes takes milliseconds that no client shall
wait for. What it says of a process that came and went between two looks is nothing.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from envhub_worker.lockdown.mechanisms import procfs

EVERY_S = 5.0
_MOST_PROCESSES = 65_536
_TICKS_A_S = os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")
_USER, _SYSTEM, _STARTED, _RESIDENT = 11, 12, 19, 21
"""Places in ``/proc/PID/stat`` after the command (proc(5)), where the state is 0."""


@dataclass(frozen=True)
class Process:
    """One look at a process.

    Attributes:
        started: When it was started, so that the number is not taken for another's.
        memory_bytes: Its share of what it has in memory; all of that where the share is not known.
    """

    pid: int
    started: int
    cpu_s: float
    memory_bytes: int


class Usage:
    """Memory, and processor time so far, of each client's jails.

    Attributes:
        memory_bytes: By client, at the last look; replaced, never changed.
        cpu_s: By client, since the start; likewise.
    """

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self.memory_bytes: Mapping[str, int] = {}
        self.cpu_s: Mapping[str, float] = {}
        self._jails: Mapping[int, str] = {}
        self._seen: dict[tuple[int, int], float] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="envhub usage", daemon=True)

    def watch(self, jails: Mapping[int, str]) -> None:
        """From now on look at these: jails' first pids, and whose they are."""
        self._jails = jails
        if jails and self._thread.ident is None:
            self._thread.start()

    def _watch(self) -> None:
        while not self._stop.wait(EVERY_S):
            try:
                self.look()
            except Exception as error:
                self._failed(error)

    def look(self) -> None:
        """Look once."""
        memory, spent = Counter[str](), dict(self.cpu_s)
        seen: dict[tuple[int, int], float] = {}
        for process, client in _members(self._jails):
            name = process.pid, process.started
            seen[name] = process.cpu_s
            memory[client] += process.memory_bytes
            more = max(0.0, process.cpu_s - self._seen.get(name, 0.0))
            spent[client] = spent.get(client, 0.0) + more
        self.memory_bytes, self.cpu_s, self._seen = memory, spent, seen

    def close(self) -> None:
        """Look no more."""
        self._stop.set()


def _members(jails: Mapping[int, str]) -> Iterator[tuple[Process, str]]:
    """All processes of the jails: each one's first, and what it has below it."""
    known = set[int]()
    for first, client in jails.items():
        waiting = [first]
        while waiting and len(known) < _MOST_PROCESSES:
            pid = waiting.pop()
            found = None if pid in known else look_at(pid)
            if found is not None:
                known.add(pid)
                yield found, client
                waiting += children(pid)


def look_at(pid: int) -> Process | None:
    """A process as the kernel describes it, or None if it has gone."""
    try:
        words = procfs.stat(pid)
        spent = (int(words[_USER]) + int(words[_SYSTEM])) / _TICKS_A_S
        resident = int(words[_RESIDENT]) * _PAGE
        started = int(words[_STARTED])
        return Process(pid, started, spent, _share(pid, resident))
    except (OSError, ValueError, IndexError):
        return None


def _share(pid: int, resident: int) -> int:
    """What a process would give back: pages that it shares count in part."""
    with contextlib.suppress(OSError):
        return procfs.numbers(f"/proc/{pid}/smaps_rollup").get(b"Pss", resident)
    return resident


def children(pid: int) -> list[int]:
    """The numbers of a process's children; none where the kernel does not tell."""
    found = list[int]()
    with contextlib.suppress(OSError):
        for thread in os.listdir(f"/proc/{pid}/task"):
            found += map(int, procfs.content(f"/proc/{pid}/task/{thread}/children").split())
    return found
