"""The memory limit around the server itself: a container's, which all its jails share."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from envhub_worker.lockdown.limits.cgroups import oom_kills

_ROOT = Path("/sys/fs/cgroup")
_COUNTS = ("memory.events", "memory/memory.oom_control")  # of version 2, and of version 1
WHY = "the memory limit around the server (its container's) was reached: the kernel ended a process"


class Around:
    """Tells a process that was killed for that limit from one that somebody killed."""

    def __init__(self, root: Path = _ROOT) -> None:
        self._events = -1
        for name in _COUNTS:
            if self._events < 0:
                with contextlib.suppress(OSError):
                    self._events = os.open(root / name, os.O_RDONLY | os.O_CLOEXEC)
        self._told = self._count()

    def killed_one(self) -> bool:
        """Whether the kernel has ended a process that was not asked about yet."""
        if self._count() <= self._told:
            return False
        self._told += 1
        return True

    def _count(self) -> int:
        try:
            return oom_kills(self._events) if self._events >= 0 else 0
        except (OSError, ValueError):
            return 0

    def close(self) -> None:
        """Close the descriptor. Idempotent."""
        if self._events >= 0:
            os.close(self._events)
            self._events = -1
