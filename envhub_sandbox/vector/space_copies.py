"""The caller's copies of the spaces in the jail: one for each space there, as long as it is equal.

In one process ``env.unwrapped.action_space`` is the same object at each access, so seeding it once
seeds it for good. Trust: a worker's number of a space chooses only among copies that are equal to
what it describes.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from envhub_sandbox.vector.generators import equal_states
from envhub_worker.protocol.spaces.reader import CHARACTER_BYTES
from envhub_worker.protocol.spaces.spaces import NUMBER, seeded_nodes

MAX_BYTES = 64 << 20
"""How much a worker may have the client remember; with more, it begins anew."""
_NODE_BYTES = 4096
_KEY_BYTES = 16
"""For each character of a Dict's keys as they are printed: most of a tuple's small numbers."""
_PLAIN = frozenset({bool, bytes, float, int, np.ndarray, str, type(None)})
"""Classes of values that contain no space. A long list of them is not walked."""
Space = gym.Space[Any]


class _Copy:
    """A copy, and the states that the jail's generators had when it was last described."""

    def __init__(self, space: Space, states: list[Any]) -> None:
        self.space = space
        self._states = states

    def follow(self, described: Space, states: list[Any]) -> Space:
        """Take over generators that have changed in the jail, where it has seeded the space.
        ``states``: for each node its described state, or None, or the index of another node.
        """
        pairs = zip(states, self._states, strict=False)
        if any(type(new) is dict and not equal_states(new, old) for new, old in pairs):
            nodes = seeded_nodes(self.space), seeded_nodes(described)
            for ours, theirs, state in zip(*nodes, states, strict=True):
                if state is not None:
                    ours._np_random = theirs._np_random
        self._states = states or self._states
        return self.space


class SpaceCopies:
    """Knows the spaces of one vector environment again.
    ``single``: its single observation space and single action space, whose numbers are 0 and 1.
    """

    def __init__(self, *single: Space) -> None:
        copies = (_Copy(space, _states_of(space)) for space in single)
        self._copies = dict(enumerate(copies))
        self._left = MAX_BYTES

    def of(self, value: Any) -> Any:
        """A worker's answer, in which known spaces are the caller's copies of them."""
        if isinstance(value, gym.Space):
            return self._known(value)
        kind = type(value)
        items = value.values() if kind is dict else value if kind in (list, tuple) else ()
        if _PLAIN.issuperset(map(type, items)):
            return value
        if kind is dict:
            return {key: self.of(item) for key, item in value.items()}
        return kind(map(self.of, value))

    def _known(self, described: Space) -> Space:
        number, states = vars(described).pop(NUMBER, (None, []))
        copy = self._copies.get(number)
        if copy and type(copy.space) is type(described) and copy.space == described:
            return copy.follow(described, states)
        if number is not None:
            self._remember(number, _Copy(described, states))
        return described

    def _remember(self, number: int, copy: _Copy) -> None:
        self._left -= sum(map(_bytes_of, seeded_nodes(copy.space)))
        if self._left < 0:
            self._copies, self._left = {}, MAX_BYTES
        else:
            self._copies[number] = copy


def _states_of(space: Space) -> list[Any]:
    generators = [node._np_random for node in seeded_nodes(space)]
    return [None if each is None else each.bit_generator.state for each in generators]


def _bytes_of(node: Space) -> int:
    """Returns at least what a node takes; its arrays, characters and keys may be large."""
    arrays = (part.nbytes for part in vars(node).values() if isinstance(part, np.ndarray))
    characters = len(node.character_set) if isinstance(node, spaces.Text) else 0
    keys = len(repr([*node.spaces])) if isinstance(node, spaces.Dict) else 0
    return _NODE_BYTES + sum(arrays) + CHARACTER_BYTES * characters + _KEY_BYTES * keys
