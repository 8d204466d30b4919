"""Measures what only a fresh interpreter can: ``python -m benchmarks.probe NAME [ARGUMENT...]``.

Prints one JSON object. Times are in milliseconds. Imports stand inside the functions, because
they are part of what is measured.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from time import perf_counter
from typing import Any

_FIRST = 3


def _ms(start: float) -> float:
    return round((perf_counter() - start) * 1000, 3)


def imports() -> dict[str, float]:
    """What importing us costs a process that has gymnasium anyway."""
    start = perf_counter()
    import gymnasium  # noqa: F401

    gymnasium_ms = _ms(start)
    start = perf_counter()
    import envhub_sandbox

    package_ms = _ms(start)
    start = perf_counter()
    envhub_sandbox.make_env  # noqa: B018 - looked up lazily
    make_env_ms = _ms(start)
    return {"gymnasium": gymnasium_ms, "package": package_ms, "make_env": make_env_ms}


def first_step(reference: str) -> dict[str, float]:
    """From nothing to the first step's result, one sub-environment."""
    begin = perf_counter()
    from envhub_sandbox import make_env

    marks = {"import": _ms(begin)}
    start = perf_counter()
    suites = make_env(reference)
    marks["make_env"] = _ms(start)
    start = perf_counter()
    suites.env.reset(seed=0)
    marks["reset"] = _ms(start)
    start = perf_counter()
    suites.env.step(suites.env.action_space.sample())
    marks["step"] = _ms(start)
    marks["total"] = _ms(begin)
    suites.close()
    return marks


def make_again(reference: str, times: str) -> dict[str, Any]:
    """``make_env`` of a remembered manifest: the first call, with its imports, and others."""
    from envhub_sandbox import make_env

    costs = []
    for _ in range(int(times) + 1):
        start = perf_counter()
        suites = make_env(reference)
        costs.append(_ms(start))
        suites.close()
    return {"first": costs[0], "later": costs[1:]}


def workers(reference: str, times: str, patience_s: str) -> dict[str, Any]:
    """Confined workers from a warm zygote: the order, until it has locked itself down.

    ``ready`` goes on until the first ``reset`` of a fresh environment returns.
    """
    from benchmarks.load import Patience
    from benchmarks.warm import Warm

    with Warm(reference, Patience(float(patience_s))) as warm:
        for _ in range(_FIRST):
            warm.spawn()
        spawned = [warm.spawn() for _ in range(int(times))]
        ready = [warm.ready() for _ in range(int(times))]
        return {
            "spawn": spawned,
            "ready": ready,
            "layers": warm.layers,
            "user": "root" if os.geteuid() == 0 else "a plain user",
        }


def memory(reference: str, count: str, num_workers: str) -> dict[str, Any]:
    """Proportional set sizes in MB, of everything that ``count`` sub-environments need."""
    from benchmarks.memory import descendants_mb
    from envhub_sandbox import make_env

    suites = make_env(reference, int(count), True, num_workers=int(num_workers))
    with suites:
        suites.env.reset(seed=0)
        for _ in range(20):
            suites.env.step(suites.env.action_space.sample())
        return descendants_mb()


def own_memory(workload: str) -> dict[str, float]:
    """What one sub-environment takes by itself where Gymnasium is there already, in MB."""
    import gymnasium.vector
    import gymnasium.wrappers  # noqa: F401

    from benchmarks.memory import growth_mb
    from benchmarks.workloads import makers

    def run() -> object:
        [make] = makers(workload, 1)
        env = make()
        env.reset(seed=0)
        for _ in range(20):
            env.step(env.action_space.sample())
        return env

    return {"total": growth_mb(run)}


def async_vector_env(context: str, count: str) -> dict[str, float]:
    """How long Gymnasium's processes take to start, until the first reset."""
    import gymnasium

    from benchmarks.workloads import makers

    start = perf_counter()
    env = gymnasium.vector.AsyncVectorEnv(makers("cartpole", int(count)), context=context)
    env.reset(seed=0)
    taken = _ms(start)
    env.close()
    return {"ready": taken}


PROBES: dict[str, Callable[..., dict[str, Any]]] = {
    probe.__name__: probe
    for probe in (imports, first_step, make_again, workers, memory, own_memory, async_vector_env)
}


if __name__ == "__main__":
    print(json.dumps(PROBES[sys.argv[1]](*sys.argv[2:])))
