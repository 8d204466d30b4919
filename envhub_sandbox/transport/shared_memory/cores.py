"""On which core each shard of an environment runs.

One core is the client's. The shards that get cores of their own may wait for work awake; one that
finds none sleeps until it is asked, and runs on the client's core while the client sleeps. Left
alone, the kernel tends to wake shards on the core of the process that woke them, and they run one
after the other. So each keeps to a core.
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

    Attributes:
        awake: How many of them, the first ones, get a core that is not the client's.
    """

    def __init__(self, shards: int) -> None:
        self.awake = min(shards, len(CPUS) - 1)
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
                self._chosen = place(len(self._chosen), self.awake, client, CPUS)
        return self._chosen


def place(shards: int, awake: int, client: int, cpus: list[int]) -> list[int]:
    """One more than each shard's core, the awake ones first."""
    others = [cpu for cpu in cpus if cpu != client]
    sleepers = [client, *others]
    return [
        1 + (others[index] if index < awake else sleepers[(index - awake) % len(sleepers)])
        for index in range(shards)
    ]
