"""Counters of an environment over several workers: of the whole, and of each of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from envhub_sandbox.session.counters import Counters
from envhub_sandbox.session.env_session import EnvSession

_ONCE = ("requests", "steps", "step_seconds")
"""Counted once for all workers; all else is their sum."""
_OF_EACH = (
    *("steps", "timeouts", "deaths", "restarts"),
    *("stale_replies", "sent_bytes", "received_bytes"),
)


class FleetCounters(Counters):
    """What has happened to all parts: see ``Counters``."""

    def __init__(self, parts: Sequence[EnvSession]) -> None:
        super().__init__()
        self._parts = [part.counters for part in parts]
        self._waited_ns = [0] * len(parts)
        self._longest_ns = [0] * len(parts)

    def waited(self, worker: int, elapsed_ns: int) -> None:
        """A step has waited so long for a worker, after those that were waited for before it."""
        self._waited_ns[worker] += elapsed_ns
        if elapsed_ns > self._longest_ns[worker]:
            self._longest_ns[worker] = elapsed_ns

    def numbers(self) -> dict[str, float]:
        """See ``Counters``."""
        own, parts = super().numbers(), [part.numbers() for part in self._parts]
        return {n: own[n] if n in _ONCE else sum(part[n] for part in parts) for n in own}

    def of_worker(self, worker: int) -> dict[str, Any]:
        """Those of one worker; a straggler is the one that steps have waited for most."""
        numbers = self._parts[worker].numbers()
        waited = {"total": self._waited_ns[worker], "max": self._longest_ns[worker]}
        return {
            **{name: numbers[name] for name in _OF_EACH},
            "waited_s": {name: ns / 1e9 for name, ns in waited.items()},
        }
