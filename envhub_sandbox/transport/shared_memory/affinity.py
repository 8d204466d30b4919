"""Which core each shard keeps to, when there are several.

Left alone, the kernel tends to wake shards on the core of whoever woke them, and they run one
after the other. So those that wait awake get cores that the client is not on, and those that
sleep get the rest, the client's first: it sleeps while they work.
"""

from __future__ import annotations

import ctypes
import os

CPUS = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]
"""The cores that this process may use."""
_LOOK_EVERY = 64
"""Steps between two looks at where the client runs."""


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
            self._look()
        return self._chosen

    def _look(self) -> None:
        client = self._getcpu() if self._getcpu is not None else -1
        if client != self._client and client in CPUS:
            self._client = client
            self._chosen = place(self._shards, self._awake, client, CPUS)


def place(shards: int, awake: int, client: int, cpus: list[int]) -> list[int]:
    """One more than each shard's core, the awake ones first."""
    others = [cpu for cpu in cpus if cpu != client]
    sleepers = [client, *others]
    return [
        1 + (others[index] if index < awake else sleepers[(index - awake) % len(sleepers)])
        for index in range(shards)
    ]
