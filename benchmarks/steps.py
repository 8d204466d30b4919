"""How fast steps are beside Gymnasium's vector environments and other libraries."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterable, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from benchmarks.driver import players
from benchmarks.interpreters import PEER_VENVS, Interpreters
from benchmarks.load import Patience, load_average
from benchmarks.machine import machine
from benchmarks.peers import PEERS
from benchmarks.plan import Cell, Plan, planned
from benchmarks.report import cell_lines, write_report
from benchmarks.rounds import CONDITIONS, measure
from benchmarks.targets import against_others, reached
from benchmarks.wellformed import problems
from benchmarks.workloads import WORKLOADS

RESULTS = Path(__file__).parent / "results"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what the arguments say; returns the exit code."""
    options = _parser().parse_args(arguments)
    if options.nice:
        os.nice(options.nice)  # all that we start inherits it, the loaded condition's too
    plan = planned(options)
    results = {
        "started": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "quick": options.quick,
        "machine": machine(),
        "load_average": load_average(),
        "nice": options.nice,
        "rounds": plan.rounds,
        "seconds": plan.seconds,
        **run(plan, Interpreters(options.venvs)),
    }
    paths = write_report(results, options.out)
    print("\n".join(map(str, paths)), file=sys.stderr)
    wrong = problems(results, plan) if options.quick else []
    print("\n".join(wrong), file=sys.stderr, end="\n" if wrong else "")
    return 1 if wrong else 0


def run(plan: Plan, interpreters: Interpreters) -> dict[str, Any]:
    """Each part of the plan."""
    patience = Patience(plan.patience_s)
    cells = _cells(plan, plan.cells, plan.peers, plan.conditions, patience, interpreters)
    return {
        "steps": cells,
        "targets": reached(cells),
        "against_others": against_others(cells),
    }


def _cells(
    plan: Plan,
    cells: Iterable[Cell],
    names: Iterable[str],
    conditions: Iterable[str],
    patience: Patience,
    interpreters: Interpreters,
) -> list[dict[str, Any]]:
    """Each workload at each size, opened once, under each condition."""
    found = []
    for workload, count in cells:
        peers = [PEERS[name] for name in names if PEERS[name].runs(workload, count)]
        with players(peers, workload, count, interpreters) as (present, absent):
            for name in conditions:
                cell = {
                    "workload": workload.name,
                    "n": count,
                    "condition": name,
                    "ready": {player.peer.name: player.ready for player in present},
                    "absent": absent,
                    **measure(present, CONDITIONS[name], plan.rounds, plan.seconds, patience),
                }
                print("\n".join(cell_lines(cell)), flush=True)
                found.append(cell)
    return found


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks steps", description=__doc__)
    add = parser.add_argument
    add(
        "--quick",
        action="store_true",
        help="under a minute: does it run, and is the report complete?",
    )
    add("--workloads", nargs="+", choices=WORKLOADS, default=list(WORKLOADS))
    add("--sizes", nargs="+", type=int, help="numbers of sub-environments")
    add("--conditions", nargs="+", choices=CONDITIONS, default=list(CONDITIONS))
    add("--peers", nargs="+", choices=PEERS, default=list(PEERS))
    add("--rounds", type=int, default=7)
    add("--seconds", type=float, default=0.25, help="length of a turn")
    add("--patience", type=float, default=60.0, help="seconds to wait for a quiet machine")
    add("--nice", type=int, default=0, help="-20, as root: for a machine that others use")
    add("--venvs", type=Path, default=PEER_VENVS, help="virtual environments of peers, by name")
    add("--out", type=Path, default=RESULTS, help="folder for the reports")
    return parser


if __name__ == "__main__":
    sys.exit(main())
