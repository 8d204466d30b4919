"""Runs one slice of a peer, and times its steps one by one."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter_ns
from typing import Any

_WARM_UP = 0.1
"""Part of a slice that is not counted: the peer has just been parked for a round."""


@dataclass(frozen=True)
class Slice:
    """One turn of a peer.

    Attributes:
        seconds: Its length, thinking included.
        least_steps: Steps that are counted even if they take longer.
        think_s: Time between steps, which is not counted.
        busy: Whether the client computes in that time, or sleeps.
    """

    seconds: float
    least_steps: int = 4
    think_s: float = 0.0
    busy: bool = True


def run_slice(opened: Any, order: Slice, actions: Iterator[Any]) -> dict[str, Any]:
    """Step until the time is over. Times are in nanoseconds per vector step."""
    warm_ns = int(order.seconds * _WARM_UP * 1e9)
    _steps(opened, order, actions, warm_ns, 2)
    costs = _steps(opened, order, actions, int(order.seconds * 1e9), order.least_steps)
    return summary(costs)


def _steps(
    opened: Any, order: Slice, actions: Iterator[Any], length_ns: int, least: int
) -> list[int]:
    step, now = opened.step, perf_counter_ns
    costs: list[int] = []
    until = now() + length_ns
    while now() < until or len(costs) < least:
        batch = next(actions)
        if order.think_s:
            _think(order)
        start = now()
        step(batch)
        costs.append(now() - start)
    return costs


def _think(order: Slice) -> None:
    if not order.busy:
        time.sleep(order.think_s)
        return
    until = perf_counter_ns() + int(order.think_s * 1e9)
    while perf_counter_ns() < until:
        pass


def summary(costs: Sequence[int]) -> dict[str, Any]:
    """Number, mean, and some percentiles."""
    ordered = sorted(costs)
    count = len(ordered)
    return {
        "steps": count,
        "p10_ns": ordered[count // 10],
        "mean_ns": sum(ordered) / count,
        "p50_ns": ordered[count // 2],
        "p95_ns": ordered[min(count - 1, count * 95 // 100)],
    }
