"""PufferLib's multiprocessing backend, whose client and workers wait awake."""

from __future__ import annotations

from functools import partial
from typing import Any

from gymnasium.spaces import Discrete
from pufferlib import emulation, vector

from benchmarks.peers.missing import Missing
from benchmarks.workloads import Workload, single


def open_peer(workload: Workload, count: int, workers: int) -> Any:
    """Sub-environments spread over ``workers`` processes."""
    if not isinstance(single(workload.name).action_space, Discrete):
        raise Missing("this version has no continuous actions")
    env = vector.make(
        partial(_wrapped, workload.name),
        num_envs=count,
        num_workers=workers,
        backend=vector.Multiprocessing,
    )
    env.reset(seed=0)
    return env


def _wrapped(name: str) -> Any:
    return emulation.GymnasiumPufferEnv(env_creator=partial(single, name))
