"""When init next looks at its jail, and whether the jail is over a limit that init measures."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Collection

from envhub_worker.lockdown.context import JailContext
from envhub_worker.lockdown.watchdog import MemoryWatch, folder_usage, seconds_to_next_look
from envhub_worker.protocol.confinement import MIB

# Counting files may take long; it then happens the more seldom.
_DISK_SHARE = 20
_DISK_LOOK_S = 0.5


class Guard:
    """Memory where no cgroup counts it, and scratch where no quota bounds it."""

    def __init__(self, jail: JailContext, *, memory: bool) -> None:
        """A guard for ``jail``; ``memory`` says whether to measure that."""
        self._limits = jail.spec.confinement.limits
        tmpfs = jail.scratch.temporary if jail.plan.namespaced else None
        self._memory = MemoryWatch(self._limits.memory_bytes, tmpfs) if memory else None
        self._folder = None if jail.plan.namespaced else os.path.dirname(jail.scratch.home)
        now = time.monotonic()
        self._memory_due = now if memory else float("inf")
        self._disk_due = now if self._folder else float("inf")

    def seconds_left(self) -> float | None:
        """Until the next look; None when nothing is measured."""
        due = min(self._memory_due, self._disk_due)
        return None if due == float("inf") else max(0.0, due - time.monotonic())

    def ignore(self, fds: list[int]) -> None:
        """Do not count these files: they are the client's."""
        if self._memory is not None:
            self._memory.ignore(fds)

    def look(self, pids: Collection[int]) -> tuple[str, str] | None:
        """(reason, detail) when the jail must end, else None."""
        now = time.monotonic()
        verdict = None
        if self._memory is not None and now >= self._memory_due:
            verdict = self._look_at_memory(self._memory, pids)
        if verdict is None and self._folder is not None and now >= self._disk_due:
            verdict = self._look_at_disk(self._folder)
        return verdict

    def _look_at_memory(self, watch: MemoryWatch, pids: Collection[int]) -> tuple[str, str] | None:
        used, hidden = watch.look(pids)
        for pid in hidden:
            # It runs a program that nobody may read, so that nobody can measure it.
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        limit = self._limits.memory_bytes
        self._memory_due = time.monotonic() + seconds_to_next_look(used, limit)
        if used <= limit:
            return None
        return "out-of-memory", f"{used // MIB} MiB in use, {limit // MIB} MiB permitted"

    def _look_at_disk(self, folder: str) -> tuple[str, str] | None:
        before = time.monotonic()
        size, files = folder_usage(folder, self._limits.disk_files)
        after = time.monotonic()
        self._disk_due = after + max(_DISK_LOOK_S, _DISK_SHARE * (after - before))
        if size > self._limits.disk_bytes:
            allowed = self._limits.disk_bytes // MIB
            return "disk-limit", f"{size // MIB} MiB of files, {allowed} MiB permitted"
        if files > self._limits.disk_files:
            return "disk-limit", f"over {self._limits.disk_files} files"
        return None
