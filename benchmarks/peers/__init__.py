"""Who is measured. Nothing heavy is imported here: the driver reads this list too."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

from benchmarks.workloads import Workload

Setting = dict[str, Any]
"""Keyword arguments for a peer's ``open``; where there are several, the fastest is taken."""


class Opened(Protocol):
    """A peer's environments, reset and ready."""

    def step(self, actions: Any) -> Any:
        """Step all of them; what comes back is the peer's own."""

    def close(self) -> None:
        """End its processes."""


def _always(workload: Workload, count: int) -> bool:
    return True


def _one_setting(count: int) -> list[Setting]:
    return [{}]


@dataclass(frozen=True)
class Peer:
    """One way to step environments.

    Attributes:
        name: On the command line and in reports.
        title: For tables.
        module: In this package; has ``open(workload, count, **setting)``.
        needs: Modules that its interpreter must have.
        runs: Whether it can run a workload at a size.
        settings: What to choose from, given the number of sub-environments.
        restless: It computes while nobody steps it, so it is stopped between its turns.
        digested: Its steps give Gymnasium's results, which can be compared bit by bit.
    """

    name: str
    title: str
    module: str
    needs: tuple[str, ...] = ("gymnasium",)
    runs: Callable[[Workload, int], bool] = _always
    settings: Callable[[int], list[Setting]] = _one_setting
    restless: bool = False
    digested: bool = False
    given: Setting = field(default_factory=dict)

    def open(self, workload: Workload, count: int, setting: Setting) -> Opened:
        """Make and reset its environments."""
        opener = importlib.import_module(f"benchmarks.peers.{self.module}").open_peer
        opened: Opened = opener(workload, count, **self.given, **setting)
        return opened


def _divisors(count: int) -> list[Setting]:
    cores = len(os.sched_getaffinity(0))
    return [{"workers": w} for w in range(1, min(cores, count) + 1) if count % w == 0]


def _threads(count: int) -> list[Setting]:
    most = min(len(os.sched_getaffinity(0)), count)
    tried = {1, 2, 4, *range(8, most, 4), most}
    return [{"threads": threads} for threads in sorted(tried) if threads <= most]


def _gymnasium(name: str, title: str, **given: Any) -> Peer:
    return Peer(name, title, "gymnasium", digested=True, given=given)


def _envhub(name: str, title: str, runs: Any = _always, **given: Any) -> Peer:
    return Peer(
        name, title, "envhub", needs=("zmq", "msgpack"), runs=runs, digested=True, given=given
    )


def _several(workload: Workload, count: int) -> bool:
    return count > 1


def _waits(workload: Workload, count: int) -> bool:
    return workload.name == "sleeping" and count > 1


SYNC, ASYNC = "sync", "async"
PEERS = {
    peer.name: peer
    for peer in (
        _gymnasium(SYNC, "gymnasium SyncVectorEnv", vector="SyncVectorEnv"),
        _gymnasium(ASYNC, "gymnasium AsyncVectorEnv", vector="AsyncVectorEnv"),
        Peer("sb3", "SB3 SubprocVecEnv", "sb3", needs=("stable_baselines3",)),
        Peer(
            "pufferlib",
            "PufferLib Multiprocessing",
            "pufferlib",
            needs=("pufferlib",),
            settings=_divisors,
            restless=True,
        ),
        Peer(
            "openenv",
            "OpenEnv, one session each",
            "openenv",
            needs=("openenv", "uvicorn"),
            runs=lambda workload, count: workload.name == "cartpole",
        ),
        Peer(
            "envpool",
            "EnvPool (C++ environments)",
            "envpool",
            needs=("envpool",),
            runs=lambda workload, count: workload.envpool is not None,
            settings=_threads,
        ),
        _envhub("envhub", "envhub", use_async_envs=True),
        _envhub(
            "envhub-one", "envhub, num_workers=1", _several, use_async_envs=True, num_workers=1
        ),
        _envhub("envhub-sync", "envhub, use_async_envs=False", use_async_envs=False),
        _envhub(
            "envhub-each", "envhub, a worker each", _waits, use_async_envs=True, num_workers=-1
        ),
        _envhub(
            "envhub-frames", "envhub, ZeroMQ lane", use_async_envs=True, policy={"lane": "frames"}
        ),
        _envhub("envhub-view", "envhub, copy=False", use_async_envs=True, copy=False),
    )
}
