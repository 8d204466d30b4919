"""What to run: parts, workloads, sizes, conditions, peers, and for how long."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass

from benchmarks.peers import ASYNC, SYNC
from benchmarks.workloads import WORKLOADS, Workload

GROWING_PEERS = (SYNC, ASYNC, "envhub", "envhub-one", "envhub-view", "envhub-frames")
_GROWING_SIZES = (1, 2, 4, 8, 16, 32, 64, 128)
_QUICK_PEERS = (SYNC, ASYNC, "envhub", "envhub-frames")

Cell = tuple[Workload, int]


@dataclass(frozen=True)
class Plan:
    """A run.

    Attributes:
        cells: Workloads and sizes of the comparison.
        growing: Workloads and sizes of the series; none if it was not asked for.
        conditions: Names.
        peers: Names.
        rounds: Turns of each peer.
        seconds: Length of a turn.
        patience_s: Seconds to wait, altogether, for others to leave the machine alone.
    """

    cells: tuple[Cell, ...]
    growing: tuple[Cell, ...]
    conditions: tuple[str, ...]
    peers: tuple[str, ...]
    rounds: int
    seconds: float
    patience_s: float

    def growing_peers(self) -> list[str]:
        """Those of the peers that the series shows."""
        return [name for name in self.peers if name in GROWING_PEERS]


def planned(options: Namespace) -> Plan:
    """The plan that the arguments ask for."""
    if options.quick:
        return _quick(options)
    series = [(WORKLOADS["cartpole"], size) for size in _GROWING_SIZES]
    series += [(one, size) for one in WORKLOADS.values() if one.grows for size in one.sizes]
    return Plan(
        cells=tuple(
            (WORKLOADS[name], size)
            for name in options.workloads
            for size in options.sizes or WORKLOADS[name].sizes
        ),
        growing=tuple(series) if options.growth else (),
        conditions=tuple(options.conditions),
        peers=tuple(options.peers),
        rounds=options.rounds,
        seconds=options.seconds,
        patience_s=options.patience,
    )


def _quick(options: Namespace) -> Plan:
    """As short as can be: says whether it runs, and nothing about speed."""
    return Plan(
        cells=((WORKLOADS["cameras"], 2),),
        growing=((WORKLOADS["bytes-64"], 4),) if options.growth else (),
        conditions=("loaded",),
        peers=tuple(name for name in options.peers if name in _QUICK_PEERS),
        rounds=2,
        seconds=0.03,
        patience_s=0.0,
    )
