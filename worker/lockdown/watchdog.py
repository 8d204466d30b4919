"""Measuring a jail's memory and scratch where no cgroup and no quota count them.

A resource limit counts one process, and misses files in memory (memfd), System V segments and
shared anonymous memory. So init looks at all processes of the jail, the sooner the nearer they
are to the limit, and ends them over it.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field

#: Bytes a second that a jail may be expected to fill: a few cores on huge pages.
_FILL_RATE = 8 * 1024**3
_SHORTEST_S, _LONGEST_S = 0.01, 1.0

_PAGE = os.sysconf("SC_PAGE_SIZE")
_SHARED = re.compile(
    rb"^([0-9a-f]+)-([0-9a-f]+) \S+ \S+ (\S+) (\d+) +/dev/zero \(deleted\)$", re.MULTILINE
)


def seconds_to_next_look(used: int, limit: int) -> float:
    """How long nothing can happen: the headroom over the rate at which memory can be filled."""
    return min(max((limit - used) / _FILL_RATE, _SHORTEST_S), _LONGEST_S)


@dataclass(frozen=True)
class Usage:
    """Memory of a jail in bytes.

    Attributes:
        private: Anonymous memory of each process, swap included.
        mapped: Shared anonymous mappings, by (device, inode).
        files: memfds that some process holds open, by (device, inode).
        other: System V segments, and files in the jail's tmpfs.
    """

    private: int = 0
    mapped: dict[tuple[bytes, bytes], int] = field(default_factory=dict)
    files: dict[tuple[int, int], int] = field(default_factory=dict)
    other: int = 0

    @property
    def total(self) -> int:
        """All of it. Pages that forked processes share are counted for each."""
        return self.private + sum(self.mapped.values()) + sum(self.files.values()) + self.other


class MemoryWatch:
    """Looks at the memory of a jail's processes."""

    def __init__(self, limit: int, tmpfs: str | None) -> None:
        """A watch for ``limit`` bytes; ``tmpfs`` is a path in the jail's own, if it has one."""
        self._limit = limit
        self._tmpfs = tmpfs
        self._foreign: set[tuple[int, int]] = set()

    def ignore(self, fds: Iterable[int]) -> None:
        """Do not count these files: they are the client's (slabs)."""
        for fd in fds:
            status = os.fstat(fd)
            self._foreign.add((status.st_dev, status.st_ino))

    def look(self, pids: Collection[int]) -> tuple[int, list[int]]:
        """(bytes in use, pids that cannot be measured).

        The cheap upper bound first; only when that is over the limit, what is really there.
        """
        usage, hidden = self._bound(pids)
        if usage.total <= self._limit:
            return usage.total, hidden
        exact = sum(_proportional(pid) for pid in pids)
        return exact + sum(usage.files.values()) + usage.other, hidden

    def _bound(self, pids: Collection[int]) -> tuple[Usage, list[int]]:
        private, other, hidden = 0, self._tmpfs_bytes() + _system_v_bytes(), []
        mapped: dict[tuple[bytes, bytes], int] = {}
        files: dict[tuple[int, int], int] = {}
        for pid in pids:
            private += _private(pid)
            try:
                mapped |= _shared_mappings(pid)
                files |= {key: size for key, size in _memfds(pid) if key not in self._foreign}
            except PermissionError:
                hidden.append(pid)
        return Usage(private, mapped, files, other), hidden

    def _tmpfs_bytes(self) -> int:
        if self._tmpfs is None:
            return 0
        status = os.statvfs(self._tmpfs)
        return (status.f_blocks - status.f_bfree) * status.f_frsize


def _private(pid: int) -> int:
    fields = _fields(f"/proc/{pid}/status")
    return fields.get(b"RssAnon", 0) + fields.get(b"VmSwap", 0)


def _fields(path: str) -> dict[bytes, int]:
    """``Name:   123 kB`` lines as bytes."""
    found: dict[bytes, int] = {}
    for line in _content(path).splitlines():
        name, _, rest = line.partition(b":")
        if rest.endswith(b" kB"):
            found[name] = int(rest[:-3]) * 1024
    return found


def _content(path: str) -> bytes:
    """A file of /proc; empty when its process has gone."""
    try:
        with open(path, "rb") as file:
            return file.read()
    except (FileNotFoundError, ProcessLookupError):
        return b""


def _shared_mappings(pid: int) -> dict[tuple[bytes, bytes], int]:
    """Size of each shared anonymous mapping: more than it may hold, never less while mapped."""
    found: dict[tuple[bytes, bytes], int] = {}
    for low, high, device, inode in _SHARED.findall(_content(f"/proc/{pid}/maps")):
        found[device, inode] = found.get((device, inode), 0) + int(high, 16) - int(low, 16)
    return found


def _memfds(pid: int) -> Iterator[tuple[tuple[int, int], int]]:
    folder = f"/proc/{pid}/fd"
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        for name in os.listdir(folder):
            with contextlib.suppress(FileNotFoundError):
                if os.readlink(f"{folder}/{name}").startswith("/memfd:"):
                    status = os.stat(f"{folder}/{name}")
                    yield (status.st_dev, status.st_ino), status.st_blocks * 512


def _system_v_bytes() -> int:
    lines = _content("/proc/sysvipc/shm").splitlines()
    if not lines:
        return 0
    columns = lines[0].split()
    rss, swap = columns.index(b"rss"), columns.index(b"swap")
    rows = [line.split() for line in lines[1:]]
    return sum(int(row[rss]) + int(row[swap]) for row in rows)


def _proportional(pid: int) -> int:
    """This process's share of anonymous memory: shared pages divided among their owners."""
    total, counted = 0, False
    for line in _content(f"/proc/{pid}/smaps").splitlines():
        name, _, rest = line.partition(b":")
        if name in (b"Pss", b"SwapPss"):
            total += int(rest[:-3]) * 1024 if counted else 0
        elif b"-" in name.split(b" ", 1)[0]:
            # A header: "from-to perms offset device inode   path". No path, or one of these.
            path = line.split(None, 5)[5:]
            counted = not path or path[0].startswith((b"[", b"/dev/zero (deleted)"))
    return total


def folder_usage(root: str, most_files: int) -> tuple[int, int]:
    """(bytes, files) below ``root``; stops counting above ``most_files``."""
    size = files = 0
    pending = [root]
    while pending and files <= most_files:
        with contextlib.suppress(OSError), os.scandir(pending.pop()) as entries:
            for entry in entries:
                files += 1
                with contextlib.suppress(OSError):
                    size += entry.stat(follow_symlinks=False).st_blocks * 512
                    if entry.is_dir(follow_symlinks=False):
                        pending.append(entry.path)
    return size, files
