"""envhub-sandbox with its default policy: every layer, every check."""

from __future__ import annotations

import inspect
from typing import Any

from benchmarks.peers.missing import Missing
from benchmarks.workloads import Workload
from envhub_sandbox import make_env


def open_peer(workload: Workload, count: int, **arguments: Any) -> Any:
    """The workload's repository; ``num_workers=-1`` means one for each sub-environment."""
    known = inspect.signature(make_env).parameters
    unknown = [name for name in arguments if name not in known]
    if unknown:
        raise Missing(f"make_env has no {', '.join(unknown)}")
    if arguments.get("num_workers") == -1:
        arguments["num_workers"] = count
    arguments["env_kwargs"] = workload.arguments
    env = make_env(str(workload.folder), n_envs=count, **arguments).env
    env.reset(seed=0)
    return env
