"""Counters of one environment: cheap to keep, put in order only when somebody asks."""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np

KEPT = 1024
"""Step latencies that are kept: the last ones. A power of two."""


class Counters:
    """What has happened to one environment.

    Attributes:
        requests: Requests sent, steps by the fast lane not among them.
        lane_steps: Steps by the fast lane.
        timeouts: Replies that were late.
        deaths: Jails that ended under a request.
        stale_replies: Late replies that were dropped, of jails that have been given up.
    """

    def __init__(self) -> None:
        self.requests = 0
        self.lane_steps = 0
        self.timeouts = 0
        self.deaths = 0
        self.stale_replies = 0
        self._steps = 0
        self._latencies = array("q", bytes(8 * KEPT))

    def stepped(self, elapsed_ns: int) -> None:
        """A step has been answered."""
        self._latencies[self._steps & (KEPT - 1)] = elapsed_ns
        self._steps += 1

    def snapshot(self) -> dict[str, Any]:
        """Plain numbers: counts, and percentiles of the last step latencies in seconds."""
        return {
            "requests": self.requests + self.lane_steps,
            "steps": self._steps,
            "timeouts": self.timeouts,
            "deaths": self.deaths,
            "stale_replies": self.stale_replies,
            "step_latency_s": self._percentiles(),
        }

    def median_step_s(self) -> float:
        """The median of the last steps, in seconds; 0 before there is one."""
        return self._percentiles().get("p50", 0.0)

    def _percentiles(self) -> dict[str, float]:
        kept = np.array(self._latencies[: min(self._steps, KEPT)], np.float64) / 1e9
        if not kept.size:
            return {}
        p50, p90, p99 = np.percentile(kept, (50, 90, 99)).tolist()
        return {"p50": p50, "p90": p90, "p99": p99, "max": float(kept.max())}
