"""Where the microseconds of one step go: ``python -m benchmarks.breakdown [WORKLOAD [SIZES...]]``.

Medians. *raw loop*: the sub-environments' own steps, in this process. *jail loop*: the same, driven
by the worker's loop in this process, for one shard. *before*: the client's Python until the
request is announced. *waiting*: until the reply is there. *wake-ups*: waiting, less the jail
loop. *after*: the client's Python and the copies until ``step`` returns. Looks into private
parts, so it breaks when they change.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from time import perf_counter_ns
from typing import Any

from benchmarks.workloads import WORKLOADS, Workload, action_batches, makers
from envhub_sandbox import make_env
from envhub_worker.jail.subenvs import SubEnvs

_STEPS = 3000
_LONGEST_NS = 1_500_000_000

COLUMNS = ("total", "raw loop", "jail loop", "before", "waiting", "wake-ups", "after")


def breakdown(workload: Workload, count: int, shards: int) -> dict[str, float]:
    """Microseconds for one vector step of ``count`` sub-environments over ``shards`` workers."""
    share = -(-count // shards)
    client = _client(workload, count, shards)
    found = {
        **client,
        "raw loop": _median(_costs(_raw_loop(workload, count))),
        "jail loop": _median(_costs(_jail_loop(workload, share))),
    }
    found["wake-ups"] = found["waiting"] - found["jail loop"]
    return {name: round(found[name], 1) for name in COLUMNS}


def _client(workload: Workload, count: int, shards: int) -> dict[str, float]:
    arguments = {"n_envs": count, "use_async_envs": True, "num_workers": shards}
    with make_env(str(workload.folder), **arguments) as suites:
        env = suites.env
        env.reset(seed=0)
        marks: list[int] = []
        lane = env._remote._lane
        lane.ask = _marking(lane.ask, marks)
        lane.wait = _marking(lane.wait, marks)
        actions = itertools.cycle(action_batches(workload.name, count))
        parts = []
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


def _marking(function: Callable[..., Any], marks: list[int]) -> Callable[..., Any]:
    def marked(*args: Any) -> Any:
        result = function(*args)
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
    return lambda: envs.run_step(next(actions)) and None


def _costs(step: Callable[[], None]) -> list[int]:
    costs = []
    until = perf_counter_ns() + _LONGEST_NS
    while len(costs) < _STEPS and perf_counter_ns() < until:
        start = perf_counter_ns()
        step()
        costs.append(perf_counter_ns() - start)
    return costs


def _median(costs: list[int]) -> float:
    return sorted(costs)[len(costs) // 2] / 1000


def main() -> None:
    """Print a table for one and two shards."""
    workload = WORKLOADS[sys.argv[1] if len(sys.argv) > 1 else "cartpole"]
    sizes = [int(size) for size in sys.argv[2:]] or list(workload.sizes)
    print("| n | shards | " + " | ".join(COLUMNS) + " |")
    print("|---" * (len(COLUMNS) + 2) + "|")
    for count in sizes:
        for shards in (1, 2) if count > 1 else (1,):
            row = breakdown(workload, count, shards)
            print(f"| {count} | {shards} | " + " | ".join(f"{v:g}" for v in row.values()) + " |")


if __name__ == "__main__":
    main()
