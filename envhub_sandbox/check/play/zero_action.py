"""The least action of a space: zero where zero is a member, and the nearest member otherwise."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import CustomSpaceError


def zero_action(space: gym.Space[Any]) -> Any:
    """A member of ``space`` that is zero, or as near to it as the space allows.
    Raises ``gymnasium.error.CustomSpaceError``: the space is none of Gymnasium's.
    """
    for kind, zero in _ZEROS.items():
        if isinstance(space, kind):
            return zero(space)
    raise CustomSpaceError(f"no zero action is known for {type(space).__name__}")


def _of_discrete(space: spaces.Discrete) -> Any:
    return space.dtype.type(min(max(0, int(space.start)), int(space.start) + int(space.n) - 1))


def _of_multi_discrete(space: spaces.MultiDiscrete) -> Any:
    return np.clip(0, space.start, space.start + space.nvec - 1).astype(space.dtype)


def _of_sequence(space: spaces.Sequence) -> Any:
    return gym.vector.utils.create_empty_array(space.feature_space, 0) if space.stack else ()


def _of_graph(space: spaces.Graph) -> Any:
    nodes = np.array([zero_action(space.node_space)])
    return spaces.GraphInstance(nodes=nodes, edges=None, edge_links=None)


_ZEROS: dict[Any, Any] = {
    spaces.Box: lambda space: np.array(
        np.clip(np.zeros(space.shape), space.low, space.high), space.dtype
    ),
    spaces.Discrete: _of_discrete,
    spaces.MultiDiscrete: _of_multi_discrete,
    spaces.MultiBinary: lambda space: np.zeros(space.shape, space.dtype),
    spaces.Text: lambda space: (
        space.character_list[0] * space.min_length if space.min_length else ""
    ),
    spaces.Dict: lambda space: {key: zero_action(one) for key, one in space.spaces.items()},
    spaces.Tuple: lambda space: tuple(map(zero_action, space.spaces)),
    spaces.Sequence: _of_sequence,
    spaces.Graph: _of_graph,
    spaces.OneOf: lambda space: (0, zero_action(space.spaces[0])),
}
