"""EnvPool: environments rewritten in C++. The ceiling, where it has the environment."""

from __future__ import annotations

from typing import Any

import envpool

from benchmarks.workloads import Workload


def open_peer(workload: Workload, count: int, threads: int) -> Any:
    """``count`` environments on ``threads`` threads, all stepped at once."""
    env = envpool.make(
        workload.envpool, env_type="gymnasium", num_envs=count, num_threads=threads, seed=0
    )
    env.reset()
    return env
