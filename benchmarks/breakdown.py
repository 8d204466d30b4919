"""Where the microseconds of one step go: ``python -m benchmarks.breakdown --help``.

Medians. *raw loop*: the sub-environments' own steps, in this process. *jail loop*: the same, driven
by the worker's loop in this process, for one shard. *before*: the client's Python until the
request is announced. *waiting*: until the reply is there. *wake-ups*: waiting, less the jail
loop. *after*: the client's Python and the copies until ``step`` returns. Each way of waiting is
forced in turn, and then left to the lane's own choice. Looks into private parts, so it breaks
when they change.
"""

from __future__ import annotations

import argparse
import itertools
import os
from collections.abc import Callable
from time import perf_counter_ns
from typing import Any

from benchmarks.load import take_precedence
from benchmarks.workloads import WORKLOADS, Workload, action_batches, makers
from envhub_sandbox import make_env
from envhub_sandbox.transport.deadline import SpinChooser
from envhub_worker.runner.sync_envs import SubEnvs
from tests.support import inside

_STEPS = 3000
_LONGEST_NS = 1_500_000_000

_SPIN_NS = {"parked": 0, "awake": 400_000, "chosen": None}
COLUMNS = ("total", "raw loop", "jail loop", "before", "waiting", "wake-ups", "after")


def breakdown(workload: Workload, count: int, shards: int) -> dict[str, dict[str, float]]:
    """Microseconds for one vector step of ``count`` sub-environments, by way of waiting."""
    raw = _median(_costs(_raw_loop(workload, count)))
    loop = _median(_costs(_jail_loop(workload, -(-count // shards))))
    rows = {}
    with make_env(
        str(workload.folder),
        count,
        use_async_envs=True,
        num_workers=shards,
        env_kwargs=workload.arguments,
    ) as suites:
        env = suites.env
        env.reset(seed=0)
        take_precedence(os.getpid())
        for way, spin_ns in _SPIN_NS.items():
            found = _client(env, action_batches(workload.name, count), spin_ns)
            found |= {"raw loop": raw, "jail loop": loop, "wake-ups": found["waiting"] - loop}
            rows[way] = {name: round(found[name], 1) for name in COLUMNS}
    return rows


def _client(env: Any, batches: list[Any], spin_ns: int | None) -> dict[str, float]:
    marks: list[int] = []
    lane = inside.lane(env)
    assert lane is not None
    lane.send_step, lane.wait = (
        _marking(type(lane).send_step, lane, marks),
        _marking(type(lane).wait, lane, marks),
    )
    inside.force_spin(lane, _Forced(spin_ns) if spin_ns is not None else SpinChooser(True))
    parts: list[tuple[int, int, int, int]] = []
    actions = itertools.cycle(batches)
    until = perf_counter_ns() + _LONGEST_NS
    while len(parts) < _STEPS and perf_counter_ns() < until:
        batch = next(actions)
        start = perf_counter_ns()
        env.step(batch)
        end = perf_counter_ns()
        asked, answered = marks
        parts.append((end - start, asked - start, answered - asked, end - answered))
        marks.clear()
    columns = ("total", "before", "waiting", "after")
    return {name: _median([part[i] for part in parts]) for i, name in enumerate(columns)}


class _Forced:
    """In place of the lane's chooser."""

    def __init__(self, budget_ns: int) -> None:
        self.budget_ns = self.host_budget_ns = budget_ns

    def measured(self, elapsed_ns: int) -> None:
        """Learn nothing."""

    def missed(self) -> None:
        """Stay with it."""


def _marking(function: Callable[..., Any], lane: Any, marks: list[int]) -> Callable[..., Any]:
    def marked(*args: Any) -> Any:
        result = function(lane, *args)
        marks.append(perf_counter_ns())
        return result

    return marked


def _raw_loop(workload: Workload, count: int) -> Callable[[], None]:
    envs = [make() for make in makers(workload.name, count)]
    for index, env in enumerate(envs):
        env.reset(seed=index)
    actions = itertools.cycle(action_batches(workload.name, count))
    over = [False] * count

    def step() -> None:
        for index, (env, action) in enumerate(zip(envs, next(actions), strict=True)):
            if over[index]:
                env.reset()
                over[index] = False
            else:
                _, _, terminated, truncated, _ = env.step(action)
                over[index] = terminated or truncated

    return step


def _jail_loop(workload: Workload, count: int) -> Callable[[], None]:
    envs = SubEnvs(makers(workload.name, count), "NextStep", sync=False)
    envs.run_reset(list(range(count)), None, None)
    actions = itertools.cycle(action_batches(workload.name, count))

    def step() -> None:
        envs.run_step(next(actions))

    return step


def _costs(step: Callable[[], None]) -> list[int]:
    costs: list[int] = []
    until = perf_counter_ns() + _LONGEST_NS
    while len(costs) < _STEPS and perf_counter_ns() < until:
        start = perf_counter_ns()
        step()
        costs.append(perf_counter_ns() - start)
    return costs


def _median(costs: list[int]) -> float:
    return sorted(costs)[len(costs) // 2] / 1000


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.breakdown")
    parser.add_argument("workload", choices=WORKLOADS)
    parser.add_argument("sizes", nargs="*", type=int)
    parser.add_argument("--shards", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--nice", type=int, default=0, help="-20: on a machine that others use")
    options = parser.parse_args()
    os.nice(options.nice)
    workload = WORKLOADS[options.workload]
    print("| n | shards | waits | " + " | ".join(COLUMNS) + " |")
    print("|---" * (len(COLUMNS) + 3) + "|")
    for count in options.sizes or workload.sizes:
        for shards in options.shards if count > 1 else (1,):
            for way, row in breakdown(workload, count, shards).items():
                cells = " | ".join(f"{value:g}" for value in row.values())
                print(f"| {count} | {shards} | {way} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
