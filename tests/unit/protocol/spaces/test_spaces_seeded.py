"""Which generators of a space travel with its description."""

from __future__ import annotations

import copy

import gymnasium as gym
import numpy as np

from envhub_worker.protocol.spaces.spaces import seeded_nodes, seeded_states


def nested() -> gym.spaces.Dict:
    pair = gym.spaces.Tuple([gym.spaces.Discrete(2), gym.spaces.Box(0, 1, (2,), np.float32)])
    return gym.spaces.Dict({"a": gym.spaces.MultiBinary(3), "b": pair})


def test_nodes_come_in_a_fixed_order() -> None:
    kinds = [type(node).__name__ for node in seeded_nodes(nested())]
    assert kinds == ["Dict", "MultiBinary", "Tuple", "Discrete", "Box"]


def test_what_nobody_seeded_does_not_travel() -> None:
    """Even where it has drawn; a remembered description would make each run the same."""
    space = nested()
    space.sample()
    assert seeded_states(space) is None


def test_the_same_seed_is_the_same_states() -> None:
    spaces = [nested() for _ in range(3)]
    for space, seed in zip(spaces, (1, 1, 2), strict=True):
        space.seed(seed)
    first, same, other = (repr(seeded_states(space)) for space in spaces)
    assert first == same != other
    spaces[0].sample()
    assert repr(seeded_states(spaces[0])) != same


def test_a_shared_generator_is_told_once() -> None:
    one = gym.spaces.Discrete(2, seed=3)
    states = seeded_states(gym.spaces.Tuple([one, copy.copy(one)]))
    assert states is not None
    assert states[2] == 1
    assert not isinstance(states[1], int)
