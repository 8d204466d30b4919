"""Measures a workload: every peer has a turn in each round, and ratios stay within the round."""

from __future__ import annotations

import random
import statistics
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

from benchmarks.clock import Slice
from benchmarks.driver import Absent, Player
from benchmarks.load import Patience, busy_processes, load_average
from benchmarks.peers import ASYNC, SYNC

_BUSY_PROCESSES = 2


@dataclass(frozen=True)
class Condition:
    """Under which circumstances peers step.

    Attributes:
        name: On the command line and in reports.
        think_s: Time that the client takes between steps.
        busy: Whether it computes in it.
        others: Whether two other processes compute all the time.
        longer: Factor on the length of a slice.
    """

    name: str
    think_s: float = 0.0
    busy: bool = True
    others: bool = False
    longer: float = 1.0


CONDITIONS = {
    condition.name: condition
    for condition in (
        Condition("quiet"),
        Condition("think", think_s=0.005, longer=2.0),
        Condition("idle", think_s=0.005, busy=False, longer=2.0),
        Condition("loaded", others=True, longer=2.0),
    )
}


def measure(
    present: list[Player], condition: Condition, rounds: int, seconds: float, patience: Patience
) -> dict[str, Any]:
    """Run rounds; returns each peer's turns and ratios, and what else the machine did.

    Args:
        present: The peers.
        condition: Under which they step.
        rounds: Turns of each.
        seconds: Length of a turn.
        patience: Waits for others to leave the machine alone, before each round.
    """
    turns: dict[str, list[dict[str, Any]]] = {player.peer.name: [] for player in present}
    failed: dict[str, str] = {}
    order = Slice(seconds * condition.longer, think_s=condition.think_s, busy=condition.busy)
    others: list[float] = []
    shuffled = random.Random(0)
    for _ in range(rounds):
        others.append(patience.wait())
        with busy_processes(_BUSY_PROCESSES) if condition.others else nullcontext():
            for player in shuffled.sample(present, len(present)):
                _take_turn(player, order, turns, failed)
    results = {name: _result(name, turns) for name in turns if name not in failed}
    return {
        "peers": results,
        "failed": failed,
        "load_average": load_average(),
        "busy_cores_before_rounds": others,
    }


def _take_turn(
    player: Player, order: Slice, turns: dict[str, list[dict[str, Any]]], failed: dict[str, str]
) -> None:
    name = player.peer.name
    if name in failed:
        return
    try:
        turns[name].append(player.turn(order))
    except Absent as error:
        failed[name] = str(error)


def _result(name: str, turns: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    own = turns[name]
    result: dict[str, Any] = {
        "turns": own,
        "step_us": _us(own, "mean_ns"),
        "p50_us": _us(own, "p50_ns"),
        "p95_us": _us(own, "p95_ns"),
    }
    for base in (SYNC, ASYNC):
        theirs = turns.get(base, [])
        if len(theirs) == len(own):
            result[f"x_{base}"] = ratios(theirs, own, "mean_ns")
            result[f"p50_x_{base}"] = ratios(theirs, own, "p50_ns")
    if len(turns.get(SYNC, [])) == len(own):
        pairs = zip(turns[SYNC], own, strict=True)
        over = [mine["mean_ns"] - sync["mean_ns"] for sync, mine in pairs]
        result["over_sync_us"] = round(statistics.median(over) / 1000, 1)
    return result


def _us(turns: list[dict[str, Any]], key: str) -> float:
    return round(float(statistics.median(turn[key] for turn in turns)) / 1000, 1)


def ratios(
    base: Sequence[dict[str, Any]], own: Sequence[dict[str, Any]], key: str
) -> dict[str, Any]:
    """How many times faster than the base, round by round: median, quartiles, all."""
    each = [theirs[key] / mine[key] for theirs, mine in zip(base, own, strict=True)]
    low, _, high = statistics.quantiles(each, n=4) if len(each) > 1 else each * 3
    return {
        "median": round(statistics.median(each), 3),
        "quartiles": [round(low, 3), round(high, 3)],
        "rounds": [round(ratio, 3) for ratio in each],
    }
