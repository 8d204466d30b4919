"""Results out of shared memory: copies that the caller owns, or slots that it borrows.

With one slot every batch is copied out. With a ring of slots (``copy=False``) a batch is handed
out where it lies, and its slot is written again only when no array of it is held any more:
each slot is a map of its own, which is the base of every array over it, views of views included,
so that its reference count tells. When all are held, the batch goes through the spare slot and is
copied.

Trust: a borrowed batch lies in memory that the jail can still write.
"""

from __future__ import annotations

import mmap
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from envhub_worker.protocol.shared_memory import slabs

RING = 4
"""Slots that are handed out: the last two batches, and two that a caller keeps."""
_SPARE = 0


class ObservationSlab:
    """The slab that all shards write their rows into: observations, rewards and flags.

    Args:
        space: The single observation space.
        layout: Where everything lies.
        received: Its memory, where that is shared with nobody; there is one slot then.

    Attributes:
        fd: Its descriptor, for the runners; -1 where there is none.
        layout: Where everything lies.
        chosen: The slot of the last batch.
    """

    def __init__(
        self,
        space: gym.Space[Any],
        layout: slabs.ObservationLayout,
        received: memoryview | None = None,
    ) -> None:
        self.layout = layout
        self._memory: Any = received
        self.fd = -1
        if received is None:
            # late, for Linux alone has what it imports
            from envhub_worker.protocol.shared_memory.descriptors import sealed_memfd

            self._memory, self._file = sealed_memfd("observations", layout.total_bytes)
            self.fd = self._file.fileno()
        self._assemble = slabs.assembler(space)
        if layout.slots == 1:
            self._slots = [self._memory]
        else:
            self._slots = [
                mmap.mmap(self.fd, layout.slot_bytes, offset=index * layout.slot_bytes)
                for index in range(layout.slots)
            ]
        self._copies = [_copier(self._slots[_SPARE], leaf) for leaf in layout.leaves]
        flat = len(self._copies) == 1 and not layout.leaves[0].path
        self._single = self._copies[0] if flat else None
        # counted just as choose() does: a loop's variable would be one more
        self._unheld = [sys.getrefcount(self._slots[index]) for index in range(len(self._slots))]
        self.chosen = _SPARE
        self._rewards, self._flags = slabs.results(self._memory, layout)

    def choose(self) -> int:
        """The slot for the next batch: the lowest that is not held, so that few stay hot."""
        self.chosen = _SPARE
        for index in range(1, len(self._slots)):
            if sys.getrefcount(self._slots[index]) == self._unheld[index]:
                self.chosen = index
                break
        return self.chosen

    def leave(self) -> None:
        """The next batch comes another way: the runners leave the slot that may be held."""
        self.chosen = _SPARE

    def take(self) -> Any:
        """The batch in the chosen slot, in the structure of the space."""
        if self.chosen == _SPARE:
            if self._single is not None:
                return self._single()
            return self._assemble([copy() for copy in self._copies])
        slot = self._slots[self.chosen]
        return self._assemble([_borrowed(slot, leaf) for leaf in self.layout.leaves])

    def results(self) -> tuple[Any, Any, Any]:
        """Copies of rewards (float64), terminations and truncations (bool), ``(num_envs,)``."""
        # cast, not viewed: a hostile byte of 2 would make a bool that is neither
        flags = self._flags.astype(np.bool_)
        count = self.layout.count
        return self._rewards.copy(), flags[:count], flags[count:]

    def close(self) -> None:
        """Give the descriptor back; the memory goes with the last array over it."""
        self._file.close()


def _copier(slot: Any, leaf: slabs.Leaf) -> Callable[[], Any]:
    if leaf.dtype.kind == "b":
        # a hostile byte of 2 would make a boolean that is neither
        return partial(slabs.view(slot, leaf, np.dtype(np.uint8)).astype, np.bool_)
    return slabs.view(slot, leaf).copy


def _borrowed(slot: mmap.mmap, leaf: slabs.Leaf) -> Any:
    if leaf.dtype.kind == "b":
        return slabs.view(slot, leaf, np.dtype(np.uint8)).astype(np.bool_)
    return slabs.view(slot, leaf)
