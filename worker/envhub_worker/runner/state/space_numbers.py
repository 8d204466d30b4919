"""Numbers of the spaces of a process, by which the client knows a space again.

``env.action_space`` is one object in Gymnasium, however often and through whichever wrapper it is
read. The client makes one copy of each object, so that what seeds the space once seeds it for good.
"""

from __future__ import annotations

import itertools
import os
import weakref
from collections.abc import Iterable
from typing import Any

import gymnasium as gym

_FIRST_BITS = 56
"""Processes begin at random numbers of so many bits, so that no two give the same."""


class SpaceNumbers:
    """Gives each space a number, which it keeps while it lives."""

    def __init__(self) -> None:
        self._numbers: dict[int, tuple[int, weakref.ref[Any]]] = {}  # by the id
        self._fresh = itertools.count(1 << _FIRST_BITS | int.from_bytes(os.urandom(6), "little"))

    def of(self, space: Any) -> int:
        """The number of a space."""
        number, known = self._numbers.get(id(space), (0, None))
        return number if known is not None else self._note(space, next(self._fresh))

    def built(self, pairs: Iterable[Iterable[Any]], start: int) -> None:
        """Number the spaces of new sub-environments, of which ``start`` is the first one's index.

        The numbers are the same in each process that builds these, also after a restart. Those of
        the first sub-environment are 0 and 1, since they are the vector environment's single ones.
        """
        for number, space in enumerate(itertools.chain.from_iterable(pairs), 2 * start):
            if isinstance(space, gym.Space):
                self._note(space, number)

    def _note(self, space: Any, number: int) -> int:
        key = id(space)
        forgets = weakref.ref(space, lambda _: self._numbers.pop(key, None))
        return self._numbers.setdefault(key, (number, forgets))[0]
