"""``get_attr`` of a plain number, by everybody who has it."""

from __future__ import annotations

import statistics
from typing import Any

from benchmarks.driver import Absent, players
from benchmarks.interpreters import Interpreters
from benchmarks.load import Patience
from benchmarks.peers import ASYNC, PEERS
from benchmarks.rounds import ratios
from benchmarks.workloads import WORKLOADS

_COUNT = 16
_TIMES = 60


def measure_attributes(
    peers: list[str], rounds: int, patience: Patience, interpreters: Interpreters
) -> dict[str, Any]:
    """Microseconds for one ``get_attr`` of 16 CartPoles, and ratios to AsyncVectorEnv."""
    turns: dict[str, list[dict[str, Any]]] = {}
    chosen = [PEERS[name] for name in peers if PEERS[name].attributes]
    with players(chosen, WORKLOADS["cartpole"], _COUNT, interpreters) as (present, absent):
        for _ in range(rounds):
            patience.wait()
            for player in present:
                if player.peer.name in absent:
                    continue
                try:
                    turns.setdefault(player.peer.name, []).append(player.get_attr(_TIMES))
                except Absent as error:
                    absent[player.peer.name] = str(error)
    found = {name: own for name, own in turns.items() if name not in absent}
    return {
        "n": _COUNT,
        "peers": {name: _result(own, found.get(ASYNC)) for name, own in found.items()},
        "absent": absent,
    }


def _result(own: list[dict[str, Any]], base: list[dict[str, Any]] | None) -> dict[str, Any]:
    result: dict[str, Any] = {
        "call_us": round(statistics.median(turn["mean_ns"] for turn in own) / 1000, 1)
    }
    if base is not None:
        result["x_async"] = ratios(base, own, "mean_ns")
    return result
