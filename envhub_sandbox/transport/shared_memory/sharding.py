"""How many processes share an environment's work, how much of it each gets, and on which core.

One core is the client's. The shards that get cores of their own wait for work awake; the others
sleep, and run on cores that another process needs too, so each of their steps costs two wake-ups
more. Where a sub-environment's step is short, that is worth several of them: such shards get
fewer. One that would save less of each step than it is worth, with its memory and its start, is
not started at all. How long a step takes is what the last use of the same pin took, so the first
one is shared out evenly. Results never depend on any of this.

Left alone, the kernel tends to wake shards on the core of the process that woke them, and they run
one after the other. So each keeps to a core: those that wait awake get cores that the client is
not on, and those that sleep get the rest, the client's first: it sleeps while they work.
"""

from __future__ import annotations

import ctypes
import os

from envhub_sandbox.transport.pace import WAKE_UP_NS, Cost, Pace
from envhub_worker.protocol.manifest.manifest import EnvManifest
from envhub_worker.protocol.spaces.batches import even_bounds

CPUS = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
"""The cores that this process may use."""
_WORTH_NS = 15_000.0
"""How much shorter each step must be for shards that sleep to be started: they take memory, and a
start that a short life does not make up for."""
_LOOK_EVERY = 64
"""Steps between two looks at where the client runs."""

Bounds = list[tuple[int, int]]


def awake_shards(shards: int) -> int:
    """How many of some shards, the first ones, get a core that is not the client's."""
    return min(shards, len(CPUS) - 1)


def bounds_for(env: EnvManifest, num_workers: int | None, pace: Pace | None) -> Bounds:
    """The slices of the sub-environments, one for each shard.

    Args:
        env: What the environment is.
        num_workers: As many shards, if they can be had; None for as many as are useful.
        pace: What it took the last time.
    """
    if not env.shardable or (num_workers is None and env.sync):
        return even_bounds(env.num_envs, 1)
    wanted = len(os.sched_getaffinity(0)) if num_workers is None else num_workers
    shards = max(1, min(wanted, env.num_envs))
    awake = awake_shards(shards)
    if pace is None or awake in (0, shards):
        return even_bounds(env.num_envs, shards)
    return _weighted(env.num_envs, shards, awake, pace, may_drop=num_workers is None)


def _weighted(count: int, shards: int, awake: int, pace: Pace, *, may_drop: bool) -> Bounds:
    """All shards done at the same time: those that sleep have fewer sub-environments."""
    quick = pace.awake
    slow = pace.asleep or Cost(quick.fixed_ns + WAKE_UP_NS, quick.step_ns)
    sleepers = shards - awake
    head_start = awake * (slow.fixed_ns - quick.fixed_ns)
    each = awake * slow.step_ns + sleepers * quick.step_ns
    small = round((count * quick.step_ns - head_start) / each)
    saved_ns = small * sleepers * quick.step_ns / awake
    if may_drop and (small < 1 or saved_ns < _WORTH_NS):
        return even_bounds(count, awake)
    small = min(max(1, small), (count - awake) // sleepers)
    large = count - sleepers * small
    return [
        *even_bounds(large, awake),
        *((start, start + small) for start in range(large, count, small)),
    ]


class Cores:
    """The cores of one environment's shards.

    Args:
        shards: How many there are.
        awake: How many of them, the first ones, may wait awake.
    """

    def __init__(self, shards: int, awake: int) -> None:
        self._shards = shards
        self._awake = awake
        self._until_look = 0
        self._client = -1
        self._chosen = [0] * shards
        self._getcpu = getattr(ctypes.CDLL(None), "sched_getcpu", None)

    def of_shards(self) -> list[int]:
        """One more than each shard's core; 0 where it does not matter."""
        self._until_look -= 1
        if self._until_look < 0:
            self._until_look = _LOOK_EVERY
            client = self._getcpu() if self._getcpu is not None else -1
            if client != self._client and client in CPUS:
                self._client = client
                self._chosen = place(self._shards, self._awake, client, CPUS)
        return self._chosen


def place(shards: int, awake: int, client: int, cpus: list[int]) -> list[int]:
    """One more than each shard's core, the awake ones first."""
    others = [cpu for cpu in cpus if cpu != client]
    sleepers = [client, *others]
    return [
        1 + (others[index] if index < awake else sleepers[(index - awake) % len(sleepers)])
        for index in range(shards)
    ]
