"""Generators of seeded spaces: which of them travel with a description, in which order.

A space that its author has seeded draws the same samples in each run, and so must its copy in the
client. One that was not seeded starts anywhere: its state does not travel, for a remembered
description would make every run start at the same place.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from envhub_worker.protocol.spaces.opaque import ARRAY_SPACES, OneOf

Space = gym.Space[Any]
States = list[Any]
_CHANCE_BITS = 64
"""The entropy of a seed; what the operating system gives has twice as many bits."""
BIT_GENERATORS = (
    np.random.PCG64,
    np.random.PCG64DXSM,
    np.random.MT19937,
    np.random.Philox,
    np.random.SFC64,
)


def seeded_nodes(space: Space) -> Iterator[Space]:
    """A space and all that it is made of, in a fixed order."""
    yield space
    for child in _children(space):
        yield from seeded_nodes(child)


def seeded_states(space: Space, single: Space | None = None) -> States | None:
    """What each node's generator is to begin with, None for those that were not seeded.

    A number says that it is the very generator of an earlier node.

    Args:
        space: The space.
        single: The one that it is a batch of, if it is. Gymnasium seeds copies of some spaces in a
            batch, by chance where they were not seeded.

    Returns:
        None if there is nothing to tell.
    """
    if single is not None and not all(map(_may_be_batched, seeded_nodes(single))):
        return None
    found: States = []
    first: dict[int, int] = {}
    for index, node in enumerate(seeded_nodes(space)):
        state = _state(node)
        # one that several share: the place of the first
        place = first.setdefault(id(getattr(node, "_np_random", None)), index)
        found.append(state if state is None or place == index else place)
    return found if any(state is not None for state in found) else None


def _children(space: Space) -> tuple[Space, ...]:
    if isinstance(space, spaces.Dict):
        return tuple(space.spaces.values())
    if isinstance(space, spaces.Tuple) or (OneOf is not None and isinstance(space, OneOf)):
        return tuple(space.spaces)
    if isinstance(space, spaces.Sequence):
        return (space.feature_space,)
    if isinstance(space, spaces.Graph):
        return (space.node_space, *(() if space.edge_space is None else (space.edge_space,)))
    return ()


def _may_be_batched(space: Space) -> bool:
    """Whether the generators of its batch are seeded only if it is."""
    return (
        isinstance(space, (*ARRAY_SPACES, spaces.Dict, spaces.Tuple)) or _state(space) is not None
    )


def _state(space: Space) -> Any:
    """The state of its generator; None if there is none, or it starts anywhere."""
    generator = getattr(space, "_np_random", None)
    if type(generator) is not np.random.Generator:
        return None
    bits = generator.bit_generator
    if type(bits) not in BIT_GENERATORS:
        return None
    sequence = getattr(bits, "seed_seq", None) or getattr(bits, "_seed_seq", None)
    entropy = getattr(sequence, "entropy", None)
    if entropy is None or (isinstance(entropy, int) and entropy.bit_length() > _CHANCE_BITS):
        return None
    return bits.state
