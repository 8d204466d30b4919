"""How well the number of worker processes is chosen, beside fixed numbers.

For each workload and size the pin is first used as often as it has ways to be tried; then all step
in turn, in one process: SyncVectorEnv, one worker, two, four and so on up to the cores, and what
was chosen (*auto*). Reported: the median over the rounds of each round's mean step. A round in
which the host took more than a few per cent of the time is left out, if others remain.
"""

from __future__ import annotations

import argparse
import itertools
import os
import statistics
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, nullcontext
from time import perf_counter
from typing import Any
from unittest.mock import patch

import gymnasium as gym

from benchmarks.clock import Slice, run_slice
from benchmarks.load import busy_processes, load_average, stolen
from benchmarks.machine import machine
from benchmarks.peers.envhub import settle
from benchmarks.workloads import WORKLOADS, Workload, action_batches, makers
from envhub_sandbox import make_env
from tests.support import inside

_WORKLOADS = ("cartpole", "halfcheetah", "cameras", "busy")
_SIZES = (1, 2, 4, 8, 16, 64)
_MOST_PIXELS = 16
"""Sub-environments with cameras: more take gigabytes."""
_LEAST_STEPS = 40
_STOLEN = 0.03
_COLUMNS = (
    *("workload", "n", "us: sync", "fixed", "auto", "auto / best fixed", "auto / sync"),
    *("shards", "uses", "stolen", "load"),
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a table, a line as soon as it is measured."""
    options = _parser().parse_args(arguments)
    if options.nice:
        os.nice(options.nice)
    facts = machine()
    print(f"{facts['processor']}, {facts['cores']} cores; {options.busy} busy processes beside\n")
    print("| " + " | ".join(_COLUMNS) + " |\n" + "|---" * len(_COLUMNS) + "|", flush=True)
    began = perf_counter()
    with (
        tempfile.TemporaryDirectory() as cache,
        patch.dict(os.environ, {"ENVHUB_CACHE": cache}),
        busy_processes(options.busy) if options.busy else nullcontext(),
    ):
        for name, count in itertools.product(options.workloads, options.sizes):
            if name != "cameras" or count <= _MOST_PIXELS:
                row = _row(WORKLOADS[name], count, options.rounds, options.seconds)
                print(row, flush=True)
    print(f"\n{perf_counter() - began:.0f} s")


def _row(workload: Workload, count: int, rounds: int, seconds: float) -> str:
    uses = settle(workload, count, seconds, use_async_envs=True)
    fixed = [1]
    while 2 * fixed[-1] <= min(count, len(os.sched_getaffinity(0))):
        fixed.append(2 * fixed[-1])
    with ExitStack() as stack:
        sync = gym.vector.SyncVectorEnv(makers(workload.name, count))
        stack.callback(sync.close)
        steppers: dict[Any, Any] = {"sync": sync}
        for workers in (*fixed, None):
            steppers[workers] = stack.enter_context(_made(workload, count, workers)).env
        for env in steppers.values():
            env.reset(seed=0)
        means, share = _turns(steppers, action_batches(workload.name, count), rounds, seconds)
        sizes = "+".join(str(stop - start) for start, stop in inside.bounds(steppers[None]))
    best, auto = min(means[workers] for workers in fixed), means[None]
    cells = (
        *(workload.title, count, round(means["sync"])),
        ", ".join(f"{workers}: {means[workers]:.0f}" for workers in fixed),
        *(round(auto), f"{auto / best:.2f}", f"{auto / means['sync']:.2f}"),
        *(sizes, uses, f"{share:.1%}", f"{load_average():.1f}"),
    )
    return "| " + " | ".join(map(str, cells)) + " |"


def _turns(
    steppers: dict[Any, Any], batches: list[Any], rounds: int, seconds: float
) -> tuple[dict[Any, float], float]:
    """Microseconds of a mean step of each, and the share of the time that was stolen."""
    actions = itertools.cycle(batches)
    taken: list[float] = []
    found: list[dict[Any, float]] = []
    for turn in range(rounds):
        order = [*steppers][turn % len(steppers) :] + [*steppers][: turn % len(steppers)]
        before = stolen()
        found.append({who: _slice(steppers[who], actions, seconds) for who in order})
        lost, passed = (late - early for late, early in zip(stolen(), before, strict=True))
        taken.append(lost / max(passed, 1))
    kept = [one for one, share in zip(found, taken, strict=True) if share <= _STOLEN] or found
    means = {who: statistics.median(one[who] for one in kept) for who in steppers}
    return means, sum(taken) / len(taken)


def _slice(env: Any, actions: Iterator[Any], seconds: float) -> float:
    return float(run_slice(env, Slice(seconds, _LEAST_STEPS), actions)["mean_ns"]) / 1e3


def _made(workload: Workload, count: int, workers: int | None) -> Any:
    return make_env(str(workload.folder), count, use_async_envs=True, num_workers=workers)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks auto", description=__doc__)
    add = parser.add_argument
    add("--workloads", nargs="+", choices=WORKLOADS, default=list(_WORKLOADS))
    add("--sizes", nargs="+", type=int, default=list(_SIZES))
    add("--rounds", type=int, default=7)
    add("--seconds", type=float, default=0.4, help="of each turn")
    add("--busy", type=int, default=0, help="processes that compute beside it")
    add("--nice", type=int, default=0, help="-20: on a machine that others use")
    return parser


if __name__ == "__main__":
    main()
