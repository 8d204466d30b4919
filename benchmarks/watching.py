"""What a process and all that it starts take: processes ever, memory at its peak, stolen time.

Processes are counted by the kernel's own announcements (the process connector, for root), which
miss none however short it lives; memory by looking again and again, in a run of its own.
"""

from __future__ import annotations

import os
import resource
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

_NETLINK_CONNECTOR, _CN_IDX_PROC, _CN_VAL_PROC = 11, 1, 1
_LISTEN = struct.pack("=I", 1)
_HEADER, _CONNECTOR = struct.Struct("=IHHII"), struct.Struct("=IIIIHH")
_FORK, _EXIT = 1, 0x80000000
_EVENT = struct.Struct("=IIQ4i")
_BUFFER_BYTES = 8 << 20
_LOOK_S = 0.02


@dataclass(frozen=True)
class Watched:
    """One run.

    Attributes:
        output: What it printed.
        ever: Processes that it has started, and these, and so on.
        peak_processes: Of them, at one time.
        peak_mb: The most by which it grew, its processes included; 0.0 where nobody looked.
        stolen: Share of the cores' time that the host took.
        load: The load average at its end.
        cpu_s: What it and its processes took of the processor, as far as they were waited for.
    """

    output: str
    ever: int
    peak_processes: int
    peak_mb: float
    stolen: float
    load: float
    cpu_s: float


def watch(
    command: Sequence[str],
    *,
    memory: bool,
    variables: Mapping[str, str] | None = None,
    timeout_s: float = 600.0,
) -> Watched:
    """Run a command to its end; with ``memory`` its memory is looked at, which disturbs.

    It prints one line once it has imported what it needs, from where on its growth counts.

    Raises:
        RuntimeError: It failed.
    """
    before, used = _jiffies(), _cpu_s()
    environment = os.environ | dict(variables or {})
    with _Forks() as forks:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
        forks.follow(process.pid)
        assert process.stdout is not None
        process.stdout.readline()
        looker = _Looker(process.pid) if memory else None
        output, _ = process.communicate(timeout=timeout_s)
        peak_mb = looker.end() if looker else 0.0
    if process.returncode:
        raise RuntimeError(f"{command} ended with {process.returncode}")
    total, stolen = (now - then for now, then in zip(_jiffies(), before, strict=True))
    share = round(stolen / max(total, 1), 4)
    load, cpu_s = os.getloadavg()[0], _cpu_s() - used
    return Watched(output, forks.ever, forks.peak, peak_mb, share, load, cpu_s)


def _cpu_s() -> float:
    """Of all that this process has waited for."""
    found = resource.getrusage(resource.RUSAGE_CHILDREN)
    return found.ru_utime + found.ru_stime


class _Forks:
    """Listens to the kernel's announcements; counts nothing where it may not."""

    def __init__(self) -> None:
        self.ever = self.peak = 0
        self._living: set[int] = set()
        self._root = 0
        self._early: list[tuple[int, int, int]] = []

    def __enter__(self) -> _Forks:
        self._socket = socket.socket(16, socket.SOCK_DGRAM, _NETLINK_CONNECTOR)
        self._socket.setsockopt(socket.SOL_SOCKET, 33, _BUFFER_BYTES)  # SO_RCVBUFFORCE
        self._socket.bind((0, _CN_IDX_PROC))
        body = _CONNECTOR.pack(_CN_IDX_PROC, _CN_VAL_PROC, 0, 0, len(_LISTEN), 0) + _LISTEN
        self._socket.send(_HEADER.pack(_HEADER.size + len(body), 3, 0, 0, os.getpid()) + body)
        self._socket.settimeout(0.2)
        self._listening = True
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._listening = False
        self._thread.join()
        self._socket.close()

    def follow(self, root: int) -> None:
        """Count what is below this process; it may have begun already."""
        self._root = root
        self._living.add(root)

    def _listen(self) -> None:
        while self._listening:
            try:
                data = self._socket.recv(4096)
            except TimeoutError:
                continue
            start = _HEADER.size + _CONNECTOR.size
            if len(data) >= start + _EVENT.size:
                self._take(*_EVENT.unpack_from(data, start))

    def _take(self, what: int, _cpu: int, _ns: int, pid: int, tgid: int, *child: int) -> None:
        if what == _FORK and child[0] == child[1]:  # else it is a thread
            self._early.append((what, tgid, child[0]))
        elif what == _EXIT and pid == tgid:
            self._early.append((what, tgid, 0))
        if self._root:
            for one in self._early:
                self._count(*one)
            self._early.clear()

    def _count(self, what: int, process: int, child: int) -> None:
        if what == _FORK and process in self._living:
            self._living.add(child)
            self.ever += 1
            self.peak = max(self.peak, len(self._living) - 1)
        elif what == _EXIT:
            self._living.discard(process)


class _Looker:
    """Looks at the memory of a process and of all below it until told to end."""

    def __init__(self, pid: int) -> None:
        self._process = psutil.Process(pid)
        self._own = self._own_first = _pss_mb(pid)
        self._peak = 0.0
        self._looking = True
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def end(self) -> float:
        """The most that was seen, in MB."""
        self._looking = False
        self._thread.join()
        return round(self._peak, 1)

    def _look(self) -> None:
        while self._looking:
            try:
                pids = [child.pid for child in self._process.children(recursive=True)]
            except psutil.NoSuchProcess:
                return
            own = _pss_mb(self._process.pid) or self._own
            grown = own - self._own_first + sum(map(_pss_mb, pids))
            self._peak = max(self._peak, grown)
            time.sleep(_LOOK_S)


def _pss_mb(pid: int) -> float:
    """0.0 for one that has gone."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    found = [int(line.split()[1]) for line in lines if line.startswith("Pss:")]
    return found[0] / 1024 if found else 0.0


def _jiffies() -> tuple[int, int]:
    """(all, stolen): see proc_stat(5)."""
    fields = [int(field) for field in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
    return sum(fields), fields[7]
