"""The counters of an environment over several workers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from envhub_sandbox.session.counters import Counters

_ONCE = ("requests", "steps", "step_seconds")
"""Counts of the whole environment; the other counts are sums over the workers."""
_OF_EACH = (
    *("steps", "timeouts", "deaths", "restarts"),
    *("stale_replies", "sent_bytes", "received_bytes"),
)


class FleetCounters(Counters):
    """The counters of an environment over several workers: see ``Counters``."""

    def __init__(self, parts: Sequence[Counters]) -> None:
        super().__init__()
        self._parts = parts
        self._waited_ns = [0] * len(parts)  # by worker, over all steps
        self._longest_ns = [0] * len(parts)  # likewise, of one step

    def waited(self, worker: int, elapsed_ns: int) -> None:
        """Add the time that a step waited for this worker, after earlier ones had answered."""
        self._waited_ns[worker] += elapsed_ns
        if elapsed_ns > self._longest_ns[worker]:
            self._longest_ns[worker] = elapsed_ns

    def numbers(self) -> dict[str, float]:
        """The counts of the whole environment; see ``Counters``."""
        own, parts = super().numbers(), [part.numbers() for part in self._parts]
        return {n: own[n] if n in _ONCE else sum(part[n] for part in parts) for n in own}

    def of_worker(self, worker: int) -> dict[str, Any]:
        """The counts of one worker; ``waited_s`` shows how long steps waited for it."""
        numbers = self._parts[worker].numbers()
        waited = {"total": self._waited_ns[worker], "max": self._longest_ns[worker]}
        return {
            **{name: numbers[name] for name in _OF_EACH},
            "waited_s": {name: ns / 1e9 for name, ns in waited.items()},
        }
