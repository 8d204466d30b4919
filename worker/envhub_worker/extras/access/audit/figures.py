"""A server's figures: its operator sees all of them, a client those about itself.

Figures are plain values that the server's thread makes and never changes afterwards, so that other
threads may read them. Clients appear by name; counts by a client's word use a fixed list of words.
``Usage`` samples the processor time and memory of jails.
"""

from __future__ import annotations

import contextlib
import os
import platform
import shutil
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from typing import Any

from envhub_worker import __version__
from envhub_worker.extras.access.quotas import Rules
from envhub_worker.lockdown.mechanisms import procfs
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.text import printable

MAX_CLIENTS = 256
"""Most clients with figures of their own; all further ones share one entry."""
OTHERS = "(others)"
OPERATIONS = ("make_env", "reset", "step", "call", "get_attr", "set_attr", "render", "close")
"""Operations that are counted by name; a client may send any name."""
REFUSALS = (
    *("sessions", "jails", "runners", "memory", "inflight", "draining", "packages"),
    *("PolicyError", "SandboxUnavailableError", "SnapshotIntegrityError", "VersionMismatchError"),
    *("LocalProtocolError", "WorkerError", "WorkerDiedError", "HelloError"),
)
"""Quotas first, then names of errors."""
_OTHER = "other"
_NAME_CHARS = 64
EVERY_S = 5.0
_TICKS_A_S = os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")
_USER, _SYSTEM, _STARTED, _RESIDENT = 11, 12, 19, 21
"""Places in ``/proc/PID/stat`` after the command (proc(5)), where the state is 0."""


@dataclass
class Tally:
    """Counts of events since the start."""

    refusals: Counter[str] = field(default_factory=Counter)
    requests: dict[str, Counter[str]] = field(default_factory=dict)
    opened: Counter[str] = field(default_factory=Counter)

    def refused(self, error: str, quota: str) -> None:
        """Count a refused request; ``quota`` names the quota that had no room, if any."""
        word = quota if quota in REFUSALS else error
        self.refusals[word if word in REFUSALS else _OTHER] += 1

    def asked(self, client: str, operation: str) -> None:
        """Count a client's request to its runners."""
        word = operation if operation in OPERATIONS else _OTHER
        if client not in self.requests:  # seldom: it is called for each step
            client = self._known(client)
            self.requests.setdefault(client, Counter())
        self.requests[client][word] += 1

    def open(self, client: str) -> None:
        """Count a started jail of a client."""
        self.opened[self._known(client)] += 1

    def _known(self, client: str) -> str:
        many = len(self.requests.keys() | self.opened.keys()) >= MAX_CLIENTS
        return OTHERS if many and client not in (*self.requests, *self.opened) else client


def facts_for_clients(rules: Rules) -> dict[str, Any]:
    """Returns the facts about a server that a client may know."""
    return {
        "version": __version__,
        "protocol": m.VERSION,
        "python": platform.python_version(),
        "profile": rules.profile,
        **asdict(rules.permissions),
        "quotas": asdict(rules.quotas),
    }


def facts_for_operators(rules: Rules, state: str) -> dict[str, Any]:
    """Returns the facts for an operator only. ``state``: the folder of keys and snapshots."""
    try:
        disk = shutil.disk_usage(state)
        size, free = disk.total, disk.free
    except OSError:
        size = free = 0
    return {
        "pid": os.getpid(),
        "pid_namespace": pid_namespace(),
        "max_connections": rules.max_connections,
        "disk": {"size_bytes": size, "free_bytes": free},
    }


def pid_namespace() -> str:
    """Returns the pid namespace of our pids; empty if the kernel does not tell."""
    with contextlib.suppress(OSError):
        return os.readlink("/proc/self/ns/pid")
    return ""


@dataclass(frozen=True)
class Process:
    """One measurement of a process.

    Attributes:
        started: Its start time, which tells it from a later process with the same pid.
        memory_bytes: Its proportional share of memory; its whole memory if the share is unknown.
    """

    pid: int
    started: int
    cpu_s: float
    memory_bytes: int


class Usage:
    """Measures the memory and total processor time of each client's jails.

    Its own thread measures: to read ``/proc`` of many processes takes milliseconds, for which no
    client should wait. It misses processes that start and end between two measurements.

    Attributes:
        memory_bytes: Memory by client at the last measurement; replaced, never changed.
        cpu_s: Processor time by client since the start; replaced, never changed.
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
        """Set the jails to measure: their first pids, and their clients."""
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
        """Measure once."""
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
        """Stop measuring."""
        self._stop.set()


def _members(jails: Mapping[int, str]) -> Iterator[tuple[Process, str]]:
    """Returns all processes of the jails: each jail's first process and its descendants."""
    children = procfs.all_children() if jails else {}
    for first, client in jails.items():
        for pid in (first, *procfs.descendants(first, children=children)):
            process = look_at(pid)
            if process is not None:
                yield process, client


def look_at(pid: int) -> Process | None:
    """Measures a process; returns None if it has ended."""
    try:
        words = procfs.stat(pid)
        spent = (int(words[_USER]) + int(words[_SYSTEM])) / _TICKS_A_S
        memory = int(words[_RESIDENT]) * _PAGE
        with contextlib.suppress(OSError):  # its share, where a shared page counts for its owners
            memory = procfs.numbers(f"/proc/{pid}/smaps_rollup").get(b"Pss", memory)
        return Process(pid, int(words[_STARTED]), spent, memory)
    except (OSError, ValueError, IndexError):
        return None


@dataclass
class Client:
    """The figures of one client: of all keys with its name."""

    sessions: int = 0
    jails: int = 0
    runners: int = 0
    memory_limit_bytes: int = 0
    memory_bytes: int = 0
    cpu_s: float = 0.0
    upload_bytes: int = 0
    inflight_bytes: int = 0
    opened: int = 0
    requests: dict[str, int] = field(default_factory=dict)


class ClientFigures:
    """The figures of all clients by name, for a bounded number of names."""

    def __init__(self) -> None:
        self.shares: dict[str, Client] = {}

    def of(self, name: str) -> Client:
        """Returns a client's figures."""
        if name not in self.shares and len(self.shares) >= MAX_CLIENTS:
            name = OTHERS
        return self.shares.setdefault(name, Client())

    def add_past(self, tally: Tally, usage: Usage) -> None:
        """Add the clients' totals since the start, which include ended jails."""
        for name, requests in tally.requests.items():
            self.of(name).requests = dict(requests)
        for name, opened in tally.opened.items():
            self.of(name).opened = opened
        for name, spent in usage.cpu_s.items():
            self.of(name).cpu_s += spent
        for name, memory in usage.memory_bytes.items():
            self.of(name).memory_bytes += memory

    def plain(self, name: str | None = None) -> Mapping[str, Any]:
        """Returns plain values of all clients, or of one client."""
        chosen = self.shares if name is None else {name: self.of(name)}
        return {client: asdict(share) for client, share in chosen.items()}


@lru_cache(maxsize=MAX_CLIENTS)
def client_name(name: str | None, insecure: bool) -> str:
    """Returns the name of a key's owner in figures, from the operator's list of clients."""
    if name is None:
        return "anybody" if insecure else "operator"
    return printable(" ".join(name[:_NAME_CHARS].split()))
