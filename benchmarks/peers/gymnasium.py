"""Gymnasium's own vector environments, in the caller's process: the baselines."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from benchmarks.workloads import Workload, makers


def open_peer(workload: Workload, count: int, vector: str) -> Any:
    """``SyncVectorEnv`` or ``AsyncVectorEnv`` (which uses shared memory), as they come."""
    env = getattr(gym.vector, vector)(makers(workload.name, count))
    env.reset(seed=0)
    return env
