"""Counters of environments, which are cheap to update and summed only when read.

``LEDGER`` keeps the counters of all environments of this process, also of closed ones, so that the
counts in ``integrations/metrics.py`` only grow.
"""

from __future__ import annotations

import threading
import weakref
from array import array
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from envhub_sandbox.system.platform import run_after_fork
from envhub_worker.protocol.lifecycle import State

if TYPE_CHECKING:
    from envhub_sandbox.transport.lane import Lane

KEPT = 1024
"""The number of last step latencies to keep. A power of two."""


class Counters:
    """Counts the requests, deaths, restarts and traffic of one environment.

    Attributes:
        timeouts: The number of late replies.
        deaths: The number of processes that ended during a request.
        restarts: The number of restarts after deaths.
    """

    def __init__(self) -> None:
        self.requests = 0
        self.timeouts = 0
        self.deaths = 0
        self.steps = 0
        self.restarts = 0
        self._total_ns = 0  # of all steps
        self._latencies = array("q", bytes(8 * KEPT))  # of the last steps, in a ring
        self._connection: Lane | None = None  # the lane whose traffic is counted now
        self._before = (0, 0, 0)  # stale replies, and bytes both ways, over earlier lanes

    def stepped(self, elapsed_ns: int) -> None:
        """Count an answered step and its latency."""
        self._latencies[self.steps & (KEPT - 1)] = elapsed_ns
        self.steps += 1
        self._total_ns += elapsed_ns

    def connected(self, connection: Lane | None) -> None:
        """Count the traffic of this connection from now on; None for no connection."""
        if connection is not self._connection:
            self._before, self._connection = self._traffic(), connection

    def _traffic(self) -> tuple[int, int, int]:
        stale, sent, received = self._before
        now = self._connection
        more = (0, 0, 0) if now is None else now.traffic()
        return stale + more[0], sent + more[1], received + more[2]

    def snapshot(self) -> dict[str, Any]:
        """Plain numbers: counts, and percentiles of the last step latencies in seconds."""
        numbers = self.numbers()
        seconds = numbers.pop("step_seconds")
        kept, latency = self.latencies_s(), {}
        if kept.size:
            p50, p90, p99 = np.percentile(kept, (50, 90, 99)).tolist()
            latency = {"p50": p50, "p90": p90, "p99": p99, "max": float(kept.max())}
        return {**numbers, "step_latency_s": {**latency, "total": seconds}}

    def numbers(self) -> dict[str, float]:
        """The counts that only grow; ``step_seconds`` is the sum of all step latencies."""
        stale, sent, received = self._traffic()
        return {
            "requests": self.requests,
            "steps": self.steps,
            "timeouts": self.timeouts,
            "deaths": self.deaths,
            "restarts": self.restarts,
            "stale_replies": stale,
            "sent_bytes": sent,
            "received_bytes": received,
            "step_seconds": self._total_ns / 1e9,
        }

    def latencies_s(self) -> Any:
        """The last step latencies, float64 ``(at most KEPT,)``, in no order."""
        return np.array(self._latencies[: min(self.steps, KEPT)], np.float64) / 1e9


# --- all environments of this process ----------------------------------------------------------


class Labels(NamedTuple):
    """The repository, suite and task of a row of numbers."""

    repository: str
    suite: str
    task: str


class Row(NamedTuple):
    """The numbers of all environments with the same labels.

    Attributes:
        numbers: The sums of ``Counters.numbers``, over living and deleted environments.
        states: The number of living environments in each state.
        latencies_s: The last step latencies of the living environments.
    """

    labels: Labels
    numbers: dict[str, float]
    states: dict[str, int]
    latencies_s: Any


class HasState(Protocol):
    """A ``Lifecycle``, or the ``FleetLifecycle`` of several workers."""

    @property
    def state(self) -> State:
        """The state of the environment."""


class Ledger:
    """The counters of all environments of this process, also of deleted ones. Thread-safe."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Drop all counters; called in a fork, since its environments belong to the parent."""
        self._lock = threading.RLock()  # interruption.md, rule 12
        self._living: dict[int, tuple[Labels, Counters, HasState]] = {}  # by the environment's id()
        self._gone: dict[Labels, dict[str, float]] = {}  # sums over deleted environments

    def add(self, env: object, labels: Labels, counters: Counters, lifecycle: HasState) -> None:
        """Add an environment. Its counts stay after it is deleted."""
        key = id(env)
        with self._lock:
            self._living[key] = labels, counters, lifecycle
        weakref.finalize(env, self._went, key).atexit = False  # interruption.md, rule 13

    def _went(self, key: int) -> None:
        with self._lock:
            entry = self._living.pop(key, None)
            if entry is not None:
                labels, counters, _ = entry
                _add(self._gone.setdefault(labels, {}), counters.numbers())

    def rows(self) -> list[Row]:
        """One row for each set of labels."""
        with self._lock:
            living = list(self._living.values())
            rows = {labels: Row(labels, dict(n), {}, []) for labels, n in self._gone.items()}
        for labels, counters, lifecycle in living:
            row = rows.setdefault(labels, Row(labels, {}, {}, []))
            _add(row.numbers, counters.numbers())
            _add(row.states, {lifecycle.state.name: 1})
            row.latencies_s.append(counters.latencies_s())
        return [
            row._replace(latencies_s=np.concatenate([[], *row.latencies_s]))
            for row in rows.values()
        ]


def _add(total: dict[str, Any], more: Mapping[str, float]) -> None:
    for name, number in more.items():
        total[name] = total.get(name, 0) + number


LEDGER = Ledger()
run_after_fork(LEDGER.forget)  # interruption.md, rule 14
