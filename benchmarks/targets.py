"""What envhub has to reach on two cores, and whether a run did."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Target:
    """At least so many times faster than Gymnasium's two classes, with default settings.

    Attributes:
        workload, condition, n: Which cell.
        sync, async_: Ratios; None where there is none to reach.
        peer: Which way of running envhub.
        over_sync_us: At most so much more than SyncVectorEnv takes, instead of a ratio.
    """

    workload: str
    condition: str
    n: int
    sync: float | None
    async_: float | None
    peer: str = "envhub"
    over_sync_us: float | None = None


TARGETS = (
    Target("cartpole", "quiet", 1, 1.2, 6),
    Target("cartpole", "quiet", 16, 1.45, 9),
    Target("cartpole", "quiet", 16, 1.05, 7, "envhub-sync"),
    Target("cartpole", "quiet", 64, 1.65, 14),
    Target("cartpole", "loaded", 16, 0.85, 5),
    Target("cartpole", "think", 16, None, 6, over_sync_us=100),
    Target("frames", "quiet", 64, 1.3, 30),
    Target("frames", "quiet", 64, 2.3, 40, "envhub-view"),
    Target("halfcheetah", "quiet", 1, 1.05, 2.7),
    Target("halfcheetah", "quiet", 16, 1.6, 3.4),
    Target("halfcheetah", "quiet", 64, 1.75, 4.5),
    Target("cameras", "quiet", 8, 1.0, 1.8),
    Target("cameras", "quiet", 8, 3.0, 6, "envhub-view"),
    Target("cartpole", "quiet", 16, 0.45, 2.8, "envhub-frames"),
    Target("busy", "quiet", 16, 1.9, 1.15),
    Target("sleeping", "quiet", 16, 12, 1.0, "envhub-each"),
)
OTHERS = {"pufferlib": 1.3, "openenv": 15.0}
"""At CartPole, 16 sub-environments, quiet: at least so many times faster than these."""


def reached(cells: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each target that the run has a cell for, with what was found."""
    by_key = {(cell["workload"], cell["condition"], cell["n"]): cell for cell in cells}
    rows = []
    for target in TARGETS:
        cell = by_key.get((target.workload, target.condition, target.n))
        result = cell["peers"].get(target.peer) if cell else None
        if cell and result and "x_sync" in result and "x_async" in result:
            rows.append(_row(target, result))
    return rows


def against_others(cells: list[dict[str, Any]]) -> dict[str, float]:
    """How many times faster than further peers, where the run has them: medians of rounds."""
    found: dict[str, float] = {}
    for cell in cells:
        if (cell["workload"], cell["condition"], cell["n"]) != ("cartpole", "quiet", 16):
            continue
        own = cell["peers"].get("envhub")
        for name in OTHERS:
            other = cell["peers"].get(name)
            if own and other:
                found[name] = round(_median_ratio(other["turns"], own["turns"]), 2)
    return found


def _median_ratio(base: list[dict[str, Any]], own: list[dict[str, Any]]) -> float:
    each = sorted(b["mean_ns"] / o["mean_ns"] for b, o in zip(base, own, strict=True))
    return float(each[len(each) // 2])


def _row(target: Target, result: dict[str, Any]) -> dict[str, Any]:
    sync, async_ = result["x_sync"]["median"], result["x_async"]["median"]
    over = result["over_sync_us"]
    kept = [
        target.sync is None or sync >= target.sync,
        target.async_ is None or async_ >= target.async_,
        target.over_sync_us is None or over <= target.over_sync_us,
    ]
    return {
        "workload": target.workload,
        "condition": target.condition,
        "n": target.n,
        "peer": target.peer,
        "target": {"sync": target.sync, "async": target.async_, "over_us": target.over_sync_us},
        "found": {"sync": sync, "async": async_, "over_us": over},
        "reached": all(kept),
    }
