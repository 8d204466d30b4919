"""Ends a jail over its limits: measures memory and scratch where no cgroup and no quota count them.

A resource limit counts one process and misses files in memory (memfd), shared anonymous memory,
and data that waits in sockets and pipes. So init measures all processes of the jail, more often
near the limit, and ends them when they are over it. The filter denies the memory that init cannot
see (``seccomp.policy.policy_table``, "measured"), or the kernel bounds it; ``plan`` names the rest.
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

#: The expected rate (bytes/s) at which a jail can fill memory: a few cores with huge pages.
_FILL_RATE = 8 * 1024**3
_SHORTEST_S, _LONGEST_S = 0.01, 1.0

_SHARED = re.compile(
    rb"^([0-9a-f]+)-([0-9a-f]+) \S+ \S+ ([0-9a-f]+):([0-9a-f]+) (\d+) +(?:/dev/zero|/memfd:.*)"
    rb" \(deleted\)$",
    re.MULTILINE,
)

# Generous sizes of the kernel's own memory: for a mapping with its reverse mapping, and for an open
# file.
_MAPPING, _DESCRIPTOR = 512, 1024
# Size of an entry of a tmpfs without blocks: inode, names, and their listing in the folder. The
# tmpfs counts extended attributes as entries of 1 KiB each.
_ENTRY = 2048
# Size of a pipe. The filter denies changing the sizes of pipes and of socket buffers.
_PIPE = 64 * 1024
# Size of a socket's buffer if the host does not tell it.
_BUFFER = 212992


def seconds_to_next_look(used: int, limit: int) -> float:
    """Returns how long the limit is safe: the headroom over the rate at which memory can fill."""
    return min(max((limit - used) / _FILL_RATE, _SHORTEST_S), _LONGEST_S)


@dataclass
class Usage:
    """Memory of a jail in bytes, measured cheaply: an upper bound.

    Attributes:
        private: Anonymous memory of each process, swap included.
        kernel: The kernel's own memory for the processes: page tables, mappings, descriptors.
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
    """Measures the memory of a jail's processes.

    Args:
        limit: The memory limit in bytes.
        tmpfs: A path in the jail's own tmpfs, if it has one.
        own_network: Whether all sockets of our network namespace belong to the jail, including
            those that wait in another socket and that no process has open.
    """

    def __init__(self, limit: int, tmpfs: str | None, *, own_network: bool = False) -> None:
        self._limit = limit
        self._tmpfs = tmpfs
        self._own_network = own_network
        self._foreign: set[tuple[int, int]] = set()  # the client's slabs, by (device, inode)

    def ignore(self, fds: Iterable[int]) -> None:
        """Do not count these files, which belong to the client (slabs)."""
        for fd in fds:
            status = os.fstat(fd)
            self._foreign.add((status.st_dev, status.st_ino))

    def look(self, pids: Collection[int]) -> tuple[int, list[int]]:
        """Returns (bytes in use, pids that cannot be measured)."""
        # The cheap upper bound comes first: it counts pages that forked processes share once for
        # each. Only if that is over the limit is the exact amount read. Shared memory may have left
        # every page table, so no process's account shows it: it counts with the size of its
        # mappings, but with no more than the whole machine shares.
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
                fields = procfs.numbers(f"/proc/{pid}/status")
                usage.private += fields.get(b"RssAnon", 0) + fields.get(b"VmSwap", 0)
                usage.kernel += fields.get(b"VmPTE", 0)
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


def _add_mappings(usage: Usage, pid: int) -> None:
    """Count each shared object by its largest mapping, at least by the filter's maximum size.

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
    """Returns the maximum bytes in one socket: a full buffer and one last message."""
    return 2 * int(procfs.content("/proc/sys/net/core/wmem_default") or _BUFFER) + _DESCRIPTOR


def _sockets() -> int:
    """All sockets of our network namespace."""
    words = procfs.content("/proc/net/sockstat").split(None, 3)
    return int(words[2]) if words[:2] == [b"sockets:", b"used"] else 0


def shared_of_the_machine() -> int:
    """Returns the bytes of shared memory and of files in memory on the whole machine."""
    fields = procfs.numbers("/proc/meminfo")
    swapped = fields.get(b"SwapTotal", 0) - fields.get(b"SwapFree", 0)
    return fields.get(b"Shmem", 0) + swapped


def unlinked_bytes(pids: Iterable[int], device: int) -> int:
    """Returns the bytes of files of ``device`` that are unlinked but still open."""
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
    """Returns a process's share of anonymous memory: shared pages are divided among their owners.

    Changed pages of a privately mapped file are anonymous, too.
    """
    fields = procfs.numbers(f"/proc/{pid}/smaps_rollup")
    return fields.get(b"Pss_Anon", fields.get(b"Pss", 0)) + fields.get(b"SwapPss", 0)


def folder_usage(root: str, most_files: int) -> tuple[int, int]:
    """Returns (bytes, files) below ``root``; stops counting above ``most_files``."""
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


# A count of files may take long. The next one waits this many times as long.
_DISK_SHARE = 20
_DISK_LOOK_S = 0.5
# The kernel has killed a process already; the watchdog ends the rest and reports the reason.
_EVENTS_LOOK_S = 0.5


class Watchdog:
    """Watches memory, by a control group's count or by measuring, and a scratch without a quota.
    ``events``: descriptor of the control group's out-of-memory count; -1 to measure instead.
    """

    def __init__(self, jail: JailContext, events: int) -> None:
        self._limits = jail.spec.confinement.limits
        tmpfs = jail.scratch.temporary if jail.common.namespaced else None
        self._events = events
        self._seen_kills = 0  # kills by the kernel that explain a death already
        own_network = jail.common.namespaced and jail.common.config.network != "host"
        self.memory = MemoryWatch(self._limits.memory_bytes, tmpfs, own_network=own_network)
        self._folder = None if jail.common.namespaced else os.path.dirname(jail.scratch.home)
        # When to look next; at once, since nothing is known yet.
        self._memory_due = time.monotonic()
        # A mounted scratch has a quota, which the kernel keeps.
        self._disk_due = time.monotonic() if self._folder else float("inf")

    def seconds_left(self) -> float:
        """Returns the seconds until the next look."""
        return max(0.0, min(self._memory_due, self._disk_due) - time.monotonic())

    def look(self, pids: Collection[int]) -> tuple[Reason, str] | None:
        """Returns (reason, detail) if the jail must end, else None."""
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
        limit = f"{self._limits.memory_bytes // MIB} MiB (memory_bytes)"
        return "out-of-memory", f"over {limit}: the kernel ended one of its processes"

    def _look_at_memory(self, pids: Collection[int]) -> tuple[Reason, str] | None:
        if self._events >= 0:
            self._memory_due = time.monotonic() + _EVENTS_LOOK_S
            return self.killed_by_kernel()
        used, hidden = self.memory.look(pids)
        for pid in hidden:
            # Such a process runs a program that may not be read, so nobody can measure it.
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        limit = self._limits.memory_bytes
        self._memory_due = time.monotonic() + seconds_to_next_look(used, limit)
        if used <= limit:
            return None
        permitted = f"{limit // MIB} MiB permitted (memory_bytes)"
        return "out-of-memory", f"{used // MIB} MiB in use, {permitted}"

    def _look_at_disk(self, folder: str, pids: Collection[int]) -> tuple[Reason, str] | None:
        before = time.monotonic()
        size, files = folder_usage(folder, self._limits.disk_files)
        size += unlinked_bytes(pids, os.stat(folder).st_dev)
        after = time.monotonic()
        self._disk_due = after + max(_DISK_LOOK_S, _DISK_SHARE * (after - before))
        if size > self._limits.disk_bytes:
            allowed = self._limits.disk_bytes // MIB
            return "disk-limit", f"{size // MIB} MiB of files, {allowed} MiB permitted (disk_bytes)"
        if files > self._limits.disk_files:
            return "disk-limit", f"over {self._limits.disk_files} files (disk_files)"
        return None
