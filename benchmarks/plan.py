"""What to run: parts, workloads, sizes, conditions, peers, and for how long."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass

from benchmarks.peers import ASYNC, SYNC
from benchmarks.workloads import WORKLOADS, Workload

_QUICK_PEERS = (SYNC, ASYNC, "envhub", "envhub-frames")

Cell = tuple[Workload, int]


@dataclass(frozen=True)
class Plan:
    """A run.

    Attributes:
        cells: Workloads and sizes of the comparison.
        conditions: Names.
        peers: Names.
        rounds: Turns of each peer.
        seconds: Length of a turn.
        patience_s: Seconds to wait, altogether, for others to leave the machine alone.
    """

    cells: tuple[Cell, ...]
    conditions: tuple[str, ...]
    peers: tuple[str, ...]
    rounds: int
    seconds: float
    patience_s: float


def planned(options: Namespace) -> Plan:
    """The plan that the arguments ask for."""
    if options.quick:
        return _quick(options)
    return Plan(
        cells=tuple(
            (WORKLOADS[name], size)
            for name in options.workloads
            for size in options.sizes or WORKLOADS[name].sizes
        ),
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
        conditions=("loaded",),
        peers=tuple(name for name in options.peers if name in _QUICK_PEERS),
        rounds=2,
        seconds=0.03,
        patience_s=0.0,
    )
