"""The zero policy's action is a member of its space, and zero where that is one."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import batch_space

from envhub_sandbox.check.play.episodes import zero_action

FEATURES = spaces.Box(1, 2, (2,), np.float32)
SPACES: list[gym.Space[Any]] = [
    spaces.Box(-1, 1, (2, 3), np.float32),
    spaces.Box(3, 4, (), np.float64),
    spaces.Box(np.array([-5, 2]), np.array([-3, 9]), dtype=np.int16),
    spaces.Box(-np.inf, np.inf, (1,), np.float32),
    spaces.Discrete(3, start=5),
    spaces.Discrete(3, start=-5),
    spaces.Discrete(3, start=-1),
    spaces.MultiDiscrete([3, 2], start=[1, -4]),
    spaces.MultiBinary((2, 3)),
    spaces.Text(5, min_length=2),
    spaces.Text(3, min_length=0),
    spaces.Tuple([FEATURES, spaces.Discrete(2)]),
    spaces.Dict(b=FEATURES, a=spaces.Dict(c=spaces.Discrete(2))),
    spaces.Sequence(FEATURES),
    spaces.Sequence(FEATURES, stack=True),
    spaces.Graph(FEATURES, None),
    spaces.Graph(spaces.Discrete(4, start=1), spaces.Discrete(2)),
    spaces.OneOf([FEATURES, spaces.Discrete(2)]),
]


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_it_is_a_member(space: gym.Space[Any]) -> None:
    """Of the single space, and batched of the batched one."""
    assert space.contains(zero_action(space))
    batched = batch_space(space, 3)
    assert batched.contains(zero_action(batched))


def test_it_is_zero_or_the_nearest() -> None:
    """Bounds and starts pull it away from zero, and nothing else does."""
    assert zero_action(SPACES[0]).tolist() == [[0.0] * 3] * 2
    assert zero_action(SPACES[2]).tolist() == [-3, 2]
    assert [zero_action(space) for space in SPACES[4:7]] == [5, -3, 0]
    assert zero_action(SPACES[7]).tolist() == [1, -3]


def test_a_space_of_nobody_is_refused() -> None:
    """Nothing is guessed."""
    with pytest.raises(gym.error.CustomSpaceError):
        zero_action(gym.Space())
