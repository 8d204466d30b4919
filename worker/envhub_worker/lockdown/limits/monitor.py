"""When init next looks at its jail, and whether the jail is over a limit that init measures."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Collection

from envhub_worker.lockdown.context import JailContext
from envhub_worker.lockdown.limits import cgroups
from envhub_worker.lockdown.limits.watchdog import (
    MemoryWatch,
    folder_usage,
    seconds_to_next_look,
    unlinked_bytes,
)
from envhub_worker.protocol.confinement import MIB, Reason

# Counting files may take long; it then happens the more seldom.
_DISK_SHARE = 20
_DISK_LOOK_S = 0.5
# The kernel has already acted; this only ends what it left, and gives it its name.
_EVENTS_LOOK_S = 0.5


class Guard:
    """Memory, by its control group's account or by measuring; scratch where no quota bounds it."""

    def __init__(self, jail: JailContext, events: int) -> None:
        """A guard for ``jail``.

        Args:
            events: Where its control group counts out-of-memory; -1 to measure instead.
        """
        self._limits = jail.spec.confinement.limits
        tmpfs = jail.scratch.temporary if jail.plan.namespaced else None
        self._events = events
        self._seen_kills = 0
        own_network = jail.plan.namespaced and jail.common.config.network != "host"
        self._memory = MemoryWatch(self._limits.memory_bytes, tmpfs, own_network=own_network)
        self._folder = None if jail.plan.namespaced else os.path.dirname(jail.scratch.home)
        self._memory_due = time.monotonic()
        self._disk_due = time.monotonic() if self._folder else float("inf")

    def seconds_left(self) -> float:
        """Until the next look."""
        return max(0.0, min(self._memory_due, self._disk_due) - time.monotonic())

    def ignore(self, fds: list[int]) -> None:
        """Do not count these files: they are the client's."""
        self._memory.ignore(fds)

    def look(self, pids: Collection[int]) -> tuple[Reason, str] | None:
        """(reason, detail) when the jail must end, else None."""
        now = time.monotonic()
        verdict = None
        if now >= self._memory_due:
            verdict = self._look_at_events() if self._events >= 0 else self._look_at_memory(pids)
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

    def _look_at_events(self) -> tuple[Reason, str] | None:
        self._memory_due = time.monotonic() + _EVENTS_LOOK_S
        return self.killed_by_kernel()

    def _look_at_memory(self, pids: Collection[int]) -> tuple[Reason, str] | None:
        used, hidden = self._memory.look(pids)
        for pid in hidden:
            # It runs a program that nobody may read, so that nobody can measure it.
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
