"""envhub-sandbox with its default policy: every layer, every check."""

from __future__ import annotations

import inspect
import itertools
from typing import Any

from benchmarks.clock import Slice, run_slice
from benchmarks.peers.missing import Missing
from benchmarks.workloads import Workload, action_batches
from envhub_sandbox import make_env
from tests.support import inside

_MOST_USES = 12


def open_peer(workload: Workload, count: int, **arguments: Any) -> Any:
    """The workload's repository; ``num_workers=-1`` means one for each sub-environment."""
    known = inspect.signature(make_env).parameters
    unknown = [name for name in arguments if name not in known]
    if unknown:
        raise Missing(f"make_env has no {', '.join(unknown)}")
    if arguments.get("num_workers") == -1:
        arguments["num_workers"] = count
    if arguments.get("use_async_envs") and arguments.get("num_workers") is None:
        settle(workload, count, **arguments)
    env = make_env(str(workload.folder), n_envs=count, **arguments).env
    env.reset(seed=0)
    return env


def settle(workload: Workload, count: int, seconds: float = 0.2, **arguments: Any) -> int:
    """Use a pin until two uses follow one another alike: the number of workers is chosen then.

    Returns:
        How many uses that took.
    """
    before = None
    for use in range(1, _MOST_USES + 1):
        with make_env(str(workload.folder), count, **arguments) as suites:
            env = suites.env
            env.reset(seed=0)
            bounds = inside.bounds(env)
            if bounds == before or count == 1:
                return use - 1
            before = bounds
            actions = itertools.cycle(action_batches(workload.name, count))
            run_slice(env, Slice(seconds, 40), actions)
    return _MOST_USES
