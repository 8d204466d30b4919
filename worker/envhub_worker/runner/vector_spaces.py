"""Finds the spaces of a vector environment that has its own ``step``: the declared ones, or those
that its first reset shows.

A class without Gymnasium's base often has ``action_space`` alone, or the same space under both
names: LeRobot's lazy vector environment has the space of one sub-environment there, Isaac Lab Arena
that of the batch. The first observation decides the *side* of such a space: True if it is the
batch's, False if it is one sub-environment's, None if the observation fits neither.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space

from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.spaces.spaces import ARRAY_SPACES
from envhub_worker.runner import gymnasium_compat as compat

Space = gym.Space[Any]
Sides = dict[Any, bool]
"""By class, so that of a suite's tasks only the first is reset."""


class MissingSpaceError(Exception):
    """A space is neither declared nor shown by an observation; the text is the attribute to add."""


@dataclass(frozen=True)
class VectorSpaces:
    """The spaces for a manifest."""

    single_observation_space: Space
    observation_space: Space
    single_action_space: Space
    action_space: Space


def spaces_of(env: Any, sides: Sides) -> VectorSpaces:
    """Returns the spaces of a vector environment; resets it if its declarations are not enough.
    Raises ``MissingSpaceError``: the reset does not show them either.
    """
    count = int(env.num_envs)
    observed, acted = _declared(env, "observation_space"), _declared(env, "action_space")
    if acted == (None, None):
        raise MissingSpaceError("single_action_space")
    side = None
    if observed == (None, None):
        observed = _space_of(_first_observation(env), count), None
        if observed[0] is None:
            raise MissingSpaceError("single_observation_space")
    elif _is_open(*observed):
        side = _side(env, observed[1], count, sides)
    observations = _settled(*observed, side, count)
    if side is None and acted[1] is not None:
        side = _looks_batched(acted[1], count)
    return VectorSpaces(*observations, *_settled(*acted, side, count))


def row_of(space: Space, count: int) -> Space | None:
    """Returns the space of one row of a batched space; None if it is no batch of ``count``."""
    if isinstance(space, spaces.Dict):
        rows = {key: row_of(sub, count) for key, sub in space.spaces.items()}
        shown = {key: row for key, row in rows.items() if row is not None}
        return spaces.Dict(shown) if rows and len(shown) == len(rows) else None
    if isinstance(space, spaces.Tuple):
        return _row_of_tuple(space, count)
    if (space.shape or ())[:1] != (count,):
        return None
    if isinstance(space, spaces.Box):
        return spaces.Box(space.low[0], space.high[0], space.shape[1:], space.dtype.type)
    if isinstance(space, spaces.MultiDiscrete) and (space.nvec == space.nvec[0]).all():
        first, start = space.nvec[0], space.start[0]
        if first.shape:
            return spaces.MultiDiscrete(first, dtype=space.dtype.type, start=start)
        return spaces.Discrete(int(first), start=int(start))
    if isinstance(space, spaces.MultiBinary) and len(space.shape) > 1:
        return spaces.MultiBinary(space.shape[1:])
    return None


def _row_of_tuple(space: spaces.Tuple[Any], count: int) -> Space | None:
    """Returns the row space of a tuple of batches, or of a tuple with a space per row."""
    rows = [row_of(sub, count) for sub in space.spaces]
    shown = [row for row in rows if row is not None]
    if rows and len(shown) == len(rows):
        return spaces.Tuple(shown)
    alike = len(rows) == count and all(sub == space.spaces[0] for sub in space.spaces)
    return space.spaces[0] if alike else None


def _declared(env: Any, name: str) -> tuple[Space | None, Space | None]:
    """Returns the declared spaces: one sub-environment's, and the batch's."""
    single, batched = getattr(env, f"single_{name}", None), getattr(env, name, None)
    if single is batched is None:
        members = getattr(env, "envs", None)
        first = members[0] if isinstance(members, (list, tuple)) and members else None
        space = getattr(first, name, None)
        single = space if isinstance(space, gym.Space) else None
    return single, batched


def _is_open(single: Space | None, batched: Space | None) -> bool:
    """Whether the declared spaces leave open which side they are on."""
    if single is None or batched is None:
        return single is None
    forms = _forms(batched)
    return bool(forms) and forms == _forms(single)


def _forms(space: Space) -> list[Any]:
    """Returns what tells a space from a batch of it: shapes of arrays, classes of other spaces."""
    if isinstance(space, spaces.Dict):
        return [(key, form) for key, sub in space.spaces.items() for form in _forms(sub)]
    if isinstance(space, spaces.Tuple):
        return [(i, form) for i, sub in enumerate(space.spaces) for form in _forms(sub)]
    return [space.shape if isinstance(space, ARRAY_SPACES) else type(space)]


def _settled(
    single: Space | None, batched: Space | None, side: bool | None, count: int
) -> tuple[Space, Space]:
    """Returns the space of one sub-environment and that of the batch, once the side is known."""
    if single is None:
        assert batched is not None
        row = row_of(batched, count) if side else None
        return (batched, batch_space(batched, count)) if row is None else (row, batched)
    if batched is None or (side is False and _is_open(single, batched)):
        return single, batch_space(single, count)
    # the environment's own batched space decides, even if it is no batch of the single one
    return single, batched


def _looks_batched(space: Space, count: int) -> bool:
    """Whether a space's shape is a batch's. A Box whose rows are single numbers is unlikely one."""
    row = row_of(space, count)
    return row is not None and () not in [
        leaf.shape for leaf in _leaves(row) if isinstance(leaf, spaces.Box)
    ]


def _leaves(space: Space) -> Iterator[Space]:
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        inner: Any = space.spaces.values() if isinstance(space, spaces.Dict) else space.spaces
        for sub in inner:
            yield from _leaves(sub)
    else:
        yield space


def _side(env: Any, space: Any, count: int, sides: Sides) -> bool | None:
    key = type(env), type(getattr(env, "unwrapped", env))
    if key not in sides:
        try:
            observation = _first_observation(env)
        except Exception:  # the caller's own reset raises it where it belongs
            return None
        votes = set(_votes(space, observation, count))
        agreed = votes.pop() if len(votes) == 1 else None
        if agreed is None:
            return None
        sides[key] = agreed
    return sides[key]


def _first_observation(env: Any) -> Any:
    return compat.reset_result(env, env.reset())[0]


def _votes(space: Space, value: Any, count: int) -> Iterator[bool | None]:
    """Yields for each leaf whether the value is one member of it, or ``count`` members."""
    if isinstance(space, spaces.Dict):
        fits = isinstance(value, Mapping) and all(key in value for key in space.spaces)
        for key, sub in space.spaces.items():
            yield from _votes(sub, value[key], count) if fits else (None,)
    elif isinstance(space, spaces.Tuple):
        fits = isinstance(value, (tuple, list)) and len(value) == len(space.spaces)
        for index, sub in enumerate(space.spaces):
            yield from _votes(sub, value[index], count) if fits else (None,)
    elif isinstance(space, ARRAY_SPACES):
        sides = {len(space.shape or ()): True, len(space.shape or ()) + 1: False}
        yield sides.get(len(np.shape(value)))
    else:
        yield not (isinstance(value, (tuple, list)) and len(value) == count)


def _space_of(value: Any, count: int) -> Space | None:
    """Returns the space of one row of a batch of observations; None if they are not numeric."""
    if isinstance(value, Mapping):
        rows = {key: _space_of(item, count) for key, item in value.items()}
        shown = {key: row for key, row in rows.items() if row is not None}
        return spaces.Dict(shown) if rows and len(shown) == len(rows) else None
    array = np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
    if array.shape[:1] != (count,) or array.dtype.kind not in "fiub":
        return None
    low, high = (0, 255) if array.dtype == np.uint8 else (-np.inf, np.inf)
    if array.dtype.kind in "ib" and array.dtype != np.uint8:
        kind = array.dtype
        low, high = (0, 1) if kind == np.bool_ else (np.iinfo(kind).min, np.iinfo(kind).max)
    return spaces.Box(low, high, array.shape[1:], array.dtype.type)
