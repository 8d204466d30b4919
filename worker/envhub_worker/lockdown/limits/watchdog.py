"""Ends a jail over its limits: measures memory and scratch where no cgroup and no quota count them.

A resource limit counts one process, and misses files in memory (memfd), shared anonymous memory
and what waits in sockets and pipes. So init looks at all processes of the jail, the sooner the
nearer they are to the limit, and ends them over it. What it cannot see the filter denies
(``seccomp.policy.policy_table``, "measured") or the kernel bounds; ``plan`` names what remains.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import signal
import time
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field

from envhub_worker.lockdown.context import JailContext
from envhub_worker.lockdown.limits import cgroups
from envhub_worker.lockdown.mechanisms import procfs
from envhub_worker.lockdown.seccomp.policy import SHARED_BYTES
from envhub_worker.protocol.confinement import MIB, Reason

#: Bytes a second that a jail may be expected to fill: a few cores on huge pages.
_FILL_RATE = 8 * 1024**3
_SHORTEST_S, _LONGEST_S = 0.01, 1.0

_SHARED = re.compile(
    rb"^([0-9a-f]+)-([0-9a-f]+) \S+ \S+ ([0-9a-f]+):([0-9a-f]+) (\d+) +(?:/dev/zero|/memfd:.*)"
    rb" \(deleted\)$",
    re.MULTILINE,
)

# Of the kernel's own memory, generously: a mapping with what reverses it, and an open file.
_MAPPING, _DESCRIPTOR = 512, 1024
# Of an entry of a tmpfs that holds no block: inode, names, and what lists them in their folder. It
# also counts attributes as so many entries, of 1 KiB each.
_ENTRY = 2048
# The filter keeps pipes, and buffers of sockets, at the size that they are made with.
_PIPE = 64 * 1024
# Of a socket, where the host does not say.
_BUFFER = 212992


def seconds_to_next_look(used: int, limit: int) -> float:
    """How long nothing can happen: the headroom over the rate at which memory can be filled."""
    return min(max((limit - used) / _FILL_RATE, _SHORTEST_S), _LONGEST_S)


@dataclass
class Usage:
    """Memory of a jail in bytes, as far as it can be had cheaply; never less than it is.

    Attributes:
        private: Anonymous memory of each process, swap included.
        kernel: What the kernel keeps for the processes: page tables, mappings, descriptors.
        mapped: Shared mappings of memory without a name, by (device, inode).
        files: memfds that some process has open, by (device, inode).
        sockets: Names of open sockets.
        pipes: Names of open pipes.
    """

    private: int = 0
    kernel: int = 0
    mapped: dict[tuple[int, int], int] = field(default_factory=dict)
    files: dict[tuple[int, int], int] = field(default_factory=dict)
    sockets: set[str] = field(default_factory=set)
    pipes: set[str] = field(default_factory=set)


class MemoryWatch:
    """Looks at the memory of a jail's processes.

    Args:
        limit: Bytes.
        tmpfs: A path in the jail's own, if it has one.
        own_network: Whether all sockets of our network namespace are the jail's, those too that
            wait in another socket, where no process has them.
    """

    def __init__(self, limit: int, tmpfs: str | None, *, own_network: bool = False) -> None:
        self._limit = limit
        self._tmpfs = tmpfs
        self._own_network = own_network
        self._foreign: set[tuple[int, int]] = set()

    def ignore(self, fds: Iterable[int]) -> None:
        """Do not count these files: they are the client's (slabs)."""
        for fd in fds:
            status = os.fstat(fd)
            self._foreign.add((status.st_dev, status.st_ino))

    def look(self, pids: Collection[int]) -> tuple[int, list[int]]:
        """(bytes in use, pids that cannot be measured).

        The cheap upper bound first, in which pages that forked processes share count for each; only
        when that is over the limit, what is really there. Shared memory may have left every page
        table, where no process's account shows it: it is what its mappings may hold, or less where
        the whole machine has less.
        """
        usage, hidden = self._usage(pids)
        shared = sum(usage.mapped.values())
        buffers = len(usage.sockets) * socket_bytes() + len(usage.pipes) * _PIPE
        others = usage.kernel + sum(usage.files.values()) + buffers + self._tmpfs_bytes()
        bound = usage.private + shared + others
        if bound <= self._limit:
            return bound, hidden
        exact = sum(_proportional(pid) for pid in pids)
        return exact + min(shared, shared_of_the_machine()) + others, hidden

    def _usage(self, pids: Collection[int]) -> tuple[Usage, list[int]]:
        usage, hidden = Usage(), []
        for pid in pids:
            try:
                _add_process(usage, pid)
                _add_mappings(usage, pid)
                _add_descriptors(usage, pid)
            except PermissionError:
                hidden.append(pid)
        for key in self._foreign:
            usage.files.pop(key, None)
            usage.mapped.pop(key, None)
        for key in usage.files:
            usage.mapped.pop(key, None)  # it is open, so that it was measured
        if self._own_network:
            usage.sockets.update(f"unseen {n}" for n in range(_sockets() - len(usage.sockets)))
        return usage, hidden

    def _tmpfs_bytes(self) -> int:
        if self._tmpfs is None:
            return 0
        status = os.statvfs(self._tmpfs)
        entries = (status.f_files - status.f_ffree) * _ENTRY
        return (status.f_blocks - status.f_bfree) * status.f_frsize + entries


def _add_process(usage: Usage, pid: int) -> None:
    fields = procfs.numbers(f"/proc/{pid}/status")
    usage.private += fields.get(b"RssAnon", 0) + fields.get(b"VmSwap", 0)
    usage.kernel += fields.get(b"VmPTE", 0)


def _add_mappings(usage: Usage, pid: int) -> None:
    """Count each shared object by its largest mapping, but no less than the filter lets be made.

    Shared memory keeps its unmapped pages as long as one page of it is mapped.
    """
    maps = procfs.content(f"/proc/{pid}/maps")
    usage.kernel += maps.count(b"\n") * _MAPPING
    sizes: dict[tuple[int, int], int] = {}
    for low, high, major, minor, inode in _SHARED.findall(maps):
        key = os.makedev(int(major, 16), int(minor, 16)), int(inode)
        sizes[key] = sizes.get(key, 0) + int(high, 16) - int(low, 16)
    for key, size in sizes.items():
        usage.mapped[key] = max(usage.mapped.get(key, SHARED_BYTES), size)


def _add_descriptors(usage: Usage, pid: int) -> None:
    folder = f"/proc/{pid}/fd"
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        names = os.listdir(folder)
        usage.kernel += len(names) * _DESCRIPTOR
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                link = os.readlink(f"{folder}/{name}")
                if link.startswith("socket:"):
                    usage.sockets.add(link)
                elif link.startswith("pipe:"):
                    usage.pipes.add(link)
                elif link.startswith("/memfd:"):
                    status = os.stat(f"{folder}/{name}")
                    usage.files[status.st_dev, status.st_ino] = status.st_blocks * 512


@functools.cache
def socket_bytes() -> int:
    """The most that waits in one socket: what fills its buffer, and a message that went in last."""
    return 2 * int(procfs.content("/proc/sys/net/core/wmem_default") or _BUFFER) + _DESCRIPTOR


def _sockets() -> int:
    """All sockets of our network namespace."""
    words = procfs.content("/proc/net/sockstat").split(None, 3)
    return int(words[2]) if words[:2] == [b"sockets:", b"used"] else 0


def shared_of_the_machine() -> int:
    """All memory that processes of this machine share, and files in memory."""
    fields = procfs.numbers("/proc/meminfo")
    swapped = fields.get(b"SwapTotal", 0) - fields.get(b"SwapFree", 0)
    return fields.get(b"Shmem", 0) + swapped


def unlinked_bytes(pids: Iterable[int], device: int) -> int:
    """What files of ``device`` take that have no name any more, but that somebody has open."""
    sizes: dict[int, int] = {}
    for pid in pids:
        folder = f"/proc/{pid}/fd"
        with contextlib.suppress(OSError):
            for name in os.listdir(folder):
                with contextlib.suppress(OSError):
                    status = os.stat(f"{folder}/{name}")
                    if status.st_nlink == 0 and status.st_dev == device:
                        sizes[status.st_ino] = status.st_blocks * 512
    return sum(sizes.values())


def _proportional(pid: int) -> int:
    """This process's share of anonymous memory: shared pages divided among their owners.

    Changed pages of a file that is mapped privately are anonymous too.
    """
    fields = procfs.numbers(f"/proc/{pid}/smaps_rollup")
    return fields.get(b"Pss_Anon", fields.get(b"Pss", 0)) + fields.get(b"SwapPss", 0)


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


# Counting files may take long; it then happens the more seldom.
_DISK_SHARE = 20
_DISK_LOOK_S = 0.5
# The kernel has already acted; this only ends what it left, and gives it its name.
_EVENTS_LOOK_S = 0.5


class Watchdog:
    """Memory, by its control group's account or by measuring; scratch where no quota bounds it.
    ``events``: where the control group counts out-of-memory; -1 to measure instead.
    """

    def __init__(self, jail: JailContext, events: int) -> None:
        self._limits = jail.spec.confinement.limits
        tmpfs = jail.scratch.temporary if jail.common.namespaced else None
        self._events = events
        self._seen_kills = 0
        own_network = jail.common.namespaced and jail.common.config.network != "host"
        self.memory = MemoryWatch(self._limits.memory_bytes, tmpfs, own_network=own_network)
        self._folder = None if jail.common.namespaced else os.path.dirname(jail.scratch.home)
        self._memory_due = time.monotonic()
        self._disk_due = time.monotonic() if self._folder else float("inf")

    def seconds_left(self) -> float:
        """Until the next look."""
        return max(0.0, min(self._memory_due, self._disk_due) - time.monotonic())

    def look(self, pids: Collection[int]) -> tuple[Reason, str] | None:
        """(reason, detail) when the jail must end, else None."""
        now = time.monotonic()
        verdict = None
        if now >= self._memory_due:
            verdict = self._look_at_memory(pids)
        if verdict is None and self._folder is not None and now >= self._disk_due:
            verdict = self._look_at_disk(self._folder, pids)
        return verdict

    def killed_by_kernel(self) -> tuple[Reason, str] | None:
        """Whether the kernel has ended a process of the control group for its memory."""
        if self._events < 0 or cgroups.oom_kills(self._events) <= self._seen_kills:
            return None
        self._seen_kills = cgroups.oom_kills(self._events)
        limit = self._limits.memory_bytes // MIB
        return "out-of-memory", f"over {limit} MiB: the kernel ended one of its processes"

    def _look_at_memory(self, pids: Collection[int]) -> tuple[Reason, str] | None:
        if self._events >= 0:
            self._memory_due = time.monotonic() + _EVENTS_LOOK_S
            return self.killed_by_kernel()
        used, hidden = self.memory.look(pids)
        for pid in hidden:
            # It runs a program that may not be read, and so cannot be measured.
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        limit = self._limits.memory_bytes
        self._memory_due = time.monotonic() + seconds_to_next_look(used, limit)
        if used <= limit:
            return None
        return "out-of-memory", f"{used // MIB} MiB in use, {limit // MIB} MiB permitted"

    def _look_at_disk(self, folder: str, pids: Collection[int]) -> tuple[Reason, str] | None:
        before = time.monotonic()
        size, files = folder_usage(folder, self._limits.disk_files)
        size += unlinked_bytes(pids, os.stat(folder).st_dev)
        after = time.monotonic()
        self._disk_due = after + max(_DISK_LOOK_S, _DISK_SHARE * (after - before))
        if size > self._limits.disk_bytes:
            allowed = self._limits.disk_bytes // MIB
            return "disk-limit", f"{size // MIB} MiB of files, {allowed} MiB permitted"
        if files > self._limits.disk_files:
            return "disk-limit", f"over {self._limits.disk_files} files"
        return None
