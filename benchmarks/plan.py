"""What to run: parts, workloads, sizes, conditions, peers, and for how long."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass

from benchmarks.peers import ASYNC, SYNC
from benchmarks.workloads import WORKLOADS, Workload

PARTS = ("steps", "growth", "attributes", "spawning")
GROWING_PEERS = (SYNC, ASYNC, "envhub", "envhub-one", "envhub-view", "envhub-frames")
_GROWING_SIZES = (1, 2, 4, 8, 16, 32, 64, 128)
_QUICK_PEERS = (SYNC, ASYNC, "envhub", "envhub-frames")

Cell = tuple[Workload, int]


@dataclass(frozen=True)
class Plan:
    """A run.

    Attributes:
        parts: Of ``PARTS``.
        cells: Workloads and sizes of the comparison.
        growing: Workloads and sizes of the series.
        conditions: Names.
        peers: Names.
        rounds: Turns of each peer.
        seconds: Length of a turn.
        spawns: Workers to spawn.
        patience_s: Seconds to wait, altogether, for others to leave the machine alone.
    """

    parts: tuple[str, ...]
    cells: tuple[Cell, ...]
    growing: tuple[Cell, ...]
    conditions: tuple[str, ...]
    peers: tuple[str, ...]
    rounds: int
    seconds: float
    spawns: int
    patience_s: float

    def growing_peers(self) -> list[str]:
        """Those of the peers that the series shows."""
        return [name for name in self.peers if name in GROWING_PEERS]


def planned(options: Namespace) -> Plan:
    """The plan that the arguments ask for."""
    if options.quick:
        return _quick(options)
    series = [workload for workload in WORKLOADS.values() if workload.grows]
    return Plan(
        parts=tuple(options.parts or PARTS),
        cells=tuple(
            (WORKLOADS[name], size)
            for name in options.workloads
            for size in options.sizes or WORKLOADS[name].sizes
        ),
        growing=(
            *((WORKLOADS["cartpole"], size) for size in _GROWING_SIZES),
            *((workload, size) for workload in series for size in workload.sizes),
        ),
        conditions=tuple(options.conditions),
        peers=tuple(options.peers),
        rounds=options.rounds,
        seconds=options.seconds,
        spawns=options.spawns,
        patience_s=options.patience,
    )


def _quick(options: Namespace) -> Plan:
    """One of everything, as short as can be: says whether it runs, and nothing about speed."""
    return Plan(
        parts=tuple(options.parts or PARTS),
        cells=((WORKLOADS["cartpole"], 4), (WORKLOADS["cameras"], 2)),
        growing=((WORKLOADS["bytes-64"], 4),),
        conditions=("quiet", "loaded"),
        peers=tuple(name for name in options.peers if name in _QUICK_PEERS),
        rounds=2,
        seconds=0.03,
        spawns=2,
        patience_s=0.0,
    )
