"""The least action of a space: zero where zero is a member, and the nearest member otherwise."""

from __future__ import annotations

from functools import singledispatch
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import CustomSpaceError


@singledispatch
def zero_action(space: gym.Space[Any]) -> Any:
    """A member of ``space`` that is zero, or as near to it as the space allows.

    Raises:
        gymnasium.error.CustomSpaceError: The space is none of Gymnasium's.
    """
    if _is_one_of(space):
        return 0, zero_action(space.spaces[0])  # type: ignore[attr-defined]
    raise CustomSpaceError(f"no zero action is known for {type(space).__name__}")


def _is_one_of(space: gym.Space[Any]) -> bool:
    kind = getattr(spaces, "OneOf", None)  # Gymnasium 0.29 has none
    return kind is not None and isinstance(space, kind)


@zero_action.register
def _(space: spaces.Box) -> Any:
    return np.array(np.clip(np.zeros(space.shape), space.low, space.high), space.dtype)


@zero_action.register
def _(space: spaces.Discrete) -> Any:
    kind = getattr(space, "dtype", None) or np.dtype(np.int64)
    return kind.type(min(max(0, int(space.start)), int(space.start) + int(space.n) - 1))


@zero_action.register
def _(space: spaces.MultiDiscrete) -> Any:
    start = getattr(space, "start", np.zeros_like(space.nvec))  # Gymnasium 0.29 has none
    return np.clip(0, start, start + space.nvec - 1).astype(space.dtype)


@zero_action.register
def _(space: spaces.MultiBinary) -> Any:
    return np.zeros(space.shape, space.dtype)


@zero_action.register
def _(space: spaces.Text) -> Any:
    return space.character_list[0] * space.min_length if space.min_length else ""


@zero_action.register
def _(space: spaces.Dict) -> Any:
    return {key: zero_action(member) for key, member in space.spaces.items()}


@zero_action.register(spaces.Tuple)  # generic in some versions of Gymnasium, plain in others
def _(space: Any) -> Any:
    return tuple(zero_action(member) for member in space.spaces)


@zero_action.register
def _(space: spaces.Sequence) -> Any:
    if not space.stack:
        return ()
    return gym.vector.utils.create_empty_array(space.feature_space, 0)


@zero_action.register
def _(space: spaces.Graph) -> Any:
    nodes = np.array([zero_action(space.node_space)])
    return spaces.GraphInstance(nodes=nodes, edges=None, edge_links=None)
