"""The command line."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from benchmarks.driver import Player, players
from benchmarks.interpreters import PEER_VENVS, Interpreters
from benchmarks.load import load_average
from benchmarks.machine import machine
from benchmarks.peers import PEERS
from benchmarks.report import cell_lines, write_report
from benchmarks.rounds import CONDITIONS, measure
from benchmarks.workloads import WORKLOADS, Workload

RESULTS = Path(__file__).parent / "results"


@dataclass
class Plan:
    """What to run.

    Attributes:
        cells: Workloads and sizes.
        conditions: Names.
        peers: Names.
        rounds: Turns of each peer.
        seconds: Length of a turn.
        patience_s: How long to wait for a quiet machine, before each round.
    """

    cells: list[tuple[Workload, int]]
    conditions: list[str]
    peers: list[str]
    rounds: int
    seconds: float
    patience_s: float


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what the arguments say; returns the exit code."""
    options = _parser().parse_args(arguments)
    plan = _plan(options)
    if options.nice:
        os.nice(options.nice)  # all that we start inherits it, the loaded condition's too
    results: dict[str, Any] = {
        "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "machine": machine(),
        "load_average": load_average(),
        "nice": options.nice,
        "rounds": plan.rounds,
        "seconds": plan.seconds,
        "cells": run(plan, Interpreters(options.venvs)),
    }
    for path in write_report(results, options.out):
        print(path, file=sys.stderr)
    return 0


def run(plan: Plan, interpreters: Interpreters) -> list[dict[str, Any]]:
    """Every workload at every size under every condition."""
    cells = []
    for workload, count in plan.cells:
        peers = [PEERS[name] for name in plan.peers if PEERS[name].runs(workload, count)]
        with players(peers, workload, count, interpreters) as (present, absent):
            for name in plan.conditions:
                cell = {
                    "workload": workload.name,
                    "n": count,
                    "condition": name,
                    "ready": {player.peer.name: player.ready for player in present},
                    "absent": absent,
                    **_measured(plan, present, name),
                }
                print("\n".join(cell_lines(cell)), flush=True)
                cells.append(cell)
    return cells


def _measured(plan: Plan, present: list[Player], condition: str) -> dict[str, Any]:
    return measure(
        present, CONDITIONS[condition], plan.rounds, plan.seconds, patience_s=plan.patience_s
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="under a minute: does it run?")
    parser.add_argument("--workloads", nargs="+", choices=WORKLOADS, default=list(WORKLOADS))
    parser.add_argument("--sizes", nargs="+", type=int, help="numbers of sub-environments")
    parser.add_argument("--conditions", nargs="+", choices=CONDITIONS, default=list(CONDITIONS))
    parser.add_argument("--peers", nargs="+", choices=PEERS, default=list(PEERS))
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=0.25, help="length of one turn")
    parser.add_argument("--patience", type=float, default=10.0, help="seconds, per round")
    parser.add_argument("--nice", type=int, default=0, help="-20: on a machine that others use")
    parser.add_argument("--venvs", type=Path, default=PEER_VENVS, help="of peers, by name")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder for the reports")
    return parser


def _plan(options: argparse.Namespace) -> Plan:
    if options.quick:
        cells = [(WORKLOADS["cartpole"], 4), (WORKLOADS["cameras"], 2)]
        peers = [name for name in options.peers if name in ("sync", "async", "envhub")]
        return Plan(cells, ["quiet"], peers, rounds=2, seconds=0.05, patience_s=0.0)
    cells = [
        (WORKLOADS[name], size)
        for name in options.workloads
        for size in options.sizes or WORKLOADS[name].sizes
    ]
    return Plan(
        cells,
        options.conditions,
        options.peers,
        options.rounds,
        options.seconds,
        options.patience,
    )
