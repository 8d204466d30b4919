"""Counters of the environments: cheap to keep, put in order only when somebody asks.

``LEDGER`` knows those of all environments of this process, so that whoever watches it
(``envhub_sandbox.metrics``) sees counts that only grow, also when environments go.
"""

from __future__ import annotations

import os
import threading
import weakref
from array import array
from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np

from envhub_worker.protocol.manifest import EnvManifest
from envhub_worker.protocol.shared_memory import slabs

KEPT = 1024
"""Step latencies that are kept: the last ones. A power of two."""


class Connection(Protocol):
    """A connection to a server, which counts by itself."""

    stale_replies: int
    sent_bytes: int
    received_bytes: int


class Counters:
    """What has happened to one environment.

    Args:
        lane_bytes: What a step by the fast lane sends and receives.

    Attributes:
        requests: Requests sent, steps by the fast lane not among them.
        lane_steps: Steps by the fast lane.
        timeouts: Replies that were late.
        deaths: Processes that ended under a request.
    """

    def __init__(self, lane_bytes: tuple[int, int] = (0, 0)) -> None:
        self.requests = 0
        self.lane_steps = 0
        self.timeouts = 0
        self.deaths = 0
        self._lane_bytes = lane_bytes
        self._steps = 0
        self._total_ns = 0
        self._latencies = array("q", bytes(8 * KEPT))
        self._connection: Connection | None = None
        self._stale = self._sent = self._received = 0

    def stepped(self, elapsed_ns: int) -> None:
        """A step has been answered."""
        self._latencies[self._steps & (KEPT - 1)] = elapsed_ns
        self._steps += 1
        self._total_ns += elapsed_ns

    def connected(self, connection: Connection) -> None:
        """From now on this connection serves the environment."""
        if connection is self._connection:
            return
        before, self._connection = self._connection, connection
        if before is not None:
            self._stale += before.stale_replies
            self._sent += before.sent_bytes
            self._received += before.received_bytes

    def snapshot(self) -> dict[str, Any]:
        """Plain numbers: counts, and percentiles of the last step latencies in seconds."""
        numbers = self.numbers()
        seconds = numbers.pop("step_seconds")
        return {**numbers, "step_latency_s": {**self._percentiles(), "total": seconds}}

    def numbers(self) -> dict[str, float]:
        """Everything that only grows; ``step_seconds`` is the sum of all step latencies."""
        now = self._connection
        sent, received = self._lane_bytes
        return {
            "requests": self.requests + self.lane_steps,
            "steps": self._steps,
            "timeouts": self.timeouts,
            "deaths": self.deaths,
            "stale_replies": self._stale + (now.stale_replies if now else 0),
            "sent_bytes": self._sent + (now.sent_bytes if now else 0) + sent * self.lane_steps,
            "received_bytes": self._received
            + (now.received_bytes if now else 0)
            + received * self.lane_steps,
            "step_seconds": self._total_ns / 1e9,
        }

    def latencies_s(self) -> Any:
        """The last step latencies, float64 ``(at most KEPT,)``, in no order."""
        return np.array(self._latencies[: min(self._steps, KEPT)], np.float64) / 1e9

    def _percentiles(self) -> dict[str, float]:
        kept = self.latencies_s()
        if not kept.size:
            return {}
        p50, p90, p99 = np.percentile(kept, (50, 90, 99)).tolist()
        return {"p50": p50, "p90": p90, "p99": p99, "max": float(kept.max())}


def lane_step_bytes(manifest: EnvManifest) -> tuple[int, int]:
    """What one step by shared memory sends and receives; infos, which vary, are left out."""
    count = manifest.num_envs
    sent = slabs.layout_of(manifest.single_action_space, count)
    received = slabs.observation_layout(manifest.single_observation_space, count, 1)
    if sent is None or received is None:
        return 0, 0
    flags = count * (8 + 1 + 1)
    return _leaf_bytes(sent.actions), _leaf_bytes(received.leaves) + flags


def _leaf_bytes(leaves: tuple[slabs.Leaf, ...]) -> int:
    return sum(int(np.prod(leaf.shape, dtype=np.int64)) * leaf.dtype.itemsize for leaf in leaves)


# --- all environments of this process ----------------------------------------------------------


class Labels(NamedTuple):
    """Whose numbers they are."""

    repository: str
    suite: str
    task: str


class Counted(Protocol):
    """An environment."""

    counters: Counters

    def stats(self) -> Mapping[str, Any]:
        """Its numbers."""


class Restarted(Protocol):
    """Whoever counts the restarts."""

    count: int


class Row(NamedTuple):
    """The numbers of all environments with the same labels.

    Attributes:
        labels: Whose they are.
        numbers: ``Counters.numbers`` and ``restarts``, of the living and of those that are gone.
        states: How many of the living are in each state.
        latencies_s: The last step latencies of the living.
    """

    labels: Labels
    numbers: dict[str, float]
    states: dict[str, int]
    latencies_s: Any


class Ledger:
    """The counters of all environments, living and gone. Thread-safe."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Begin anew: in a fork, whose environments are its parent's."""
        self._lock = threading.RLock()  # the garbage collector may come while it is held
        self._living: dict[int, tuple[Labels, weakref.ref[Counted], Counters, Restarted]] = {}
        self._gone: dict[Labels, dict[str, float]] = {}

    def add(self, env: Counted, labels: Labels, restarts: Restarted) -> None:
        """An environment has come; when it goes, its counts stay."""
        key = id(env)
        with self._lock:
            self._living[key] = (labels, weakref.ref(env), env.counters, restarts)
        weakref.finalize(env, self._went, key).atexit = False

    def _went(self, key: int) -> None:
        with self._lock:
            entry = self._living.pop(key, None)
            if entry is not None:
                labels, _, counters, restarts = entry
                _add(self._gone.setdefault(labels, {}), _numbers(counters, restarts))

    def rows(self) -> list[Row]:
        """A row for each set of labels."""
        with self._lock:
            living = list(self._living.values())
            rows = {labels: Row(labels, dict(n), {}, []) for labels, n in self._gone.items()}
        for labels, env, counters, restarts in living:
            row = rows.setdefault(labels, Row(labels, {}, {}, []))
            _add(row.numbers, _numbers(counters, restarts))
            found = env()
            if found is not None:
                _add(row.states, {found.stats()["state"]: 1})
            row.latencies_s.append(counters.latencies_s())
        return [
            row._replace(latencies_s=np.concatenate([[], *row.latencies_s]))
            for row in rows.values()
        ]


def _numbers(counters: Counters, restarts: Restarted) -> dict[str, float]:
    return {**counters.numbers(), "restarts": restarts.count}


def _add(total: dict[str, Any], more: Mapping[str, float]) -> None:
    for name, number in more.items():
        total[name] = total.get(name, 0) + number


LEDGER = Ledger()
os.register_at_fork(after_in_child=LEDGER.forget)
