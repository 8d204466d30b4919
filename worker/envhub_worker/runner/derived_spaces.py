"""Spaces of a vector environment that names none of one sub-environment, from its first reset.

A class without Gymnasium's base often has ``action_space`` alone, batched or not, and perhaps
``observation_space``. What it observes shows which of the two they are.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from envhub_worker.protocol.spaces.spaces import ARRAY_SPACES

_KEY = "_envhub_spaces"
"""Where an environment keeps them, beside its own attributes, which stay what they are."""


def derive_spaces(env: Any) -> str:
    """Find spaces of one sub-environment where a vector environment names none.

    Returns:
        The attribute that has to be added, or nothing.
    """
    found: dict[str, gym.Space[Any]] = {}
    batched = False  # which of the two, its observation says
    if getattr(env, "single_observation_space", None) is None:
        observation, _ = env.reset()
        declared: Any = getattr(env, "observation_space", None)
        batched = declared is not None and _has_shape(declared, observation)
        single = _member(declared, env.num_envs) if batched else declared
        if declared is None:
            single = _space_of(observation, env.num_envs)
        if single is None:
            return "single_observation_space"
        found["observation_space"] = single
    if getattr(env, "single_action_space", None) is None:
        declared = getattr(env, "action_space", None)
        if declared is None:
            return "single_action_space"
        several = batched or len(declared.shape or ()) > 1
        single = _member(declared, env.num_envs) if several else None
        found["action_space"] = declared if single is None else single
    if found:
        setattr(env, _KEY, found)
    return ""


def derived_space(env: Any, name: str) -> gym.Space[Any] | None:
    """The single space that was found for ``observation_space`` or ``action_space``, if one was."""
    found: gym.Space[Any] | None = getattr(env, _KEY, {}).get(name)
    return found


def _has_shape(space: gym.Space[Any], value: Any) -> bool:
    """Whether a value has the structure and the shapes of a space."""
    if isinstance(space, spaces.Dict):
        known = isinstance(value, dict) and value.keys() == space.spaces.keys()
        return known and all(_has_shape(sub, value[key]) for key, sub in space.spaces.items())
    return isinstance(space, ARRAY_SPACES) and np.shape(value) == space.shape


def _member(space: gym.Space[Any], count: int) -> gym.Space[Any] | None:
    """One row of a batched space; None where it is no batch of so many."""
    if isinstance(space, spaces.Dict):
        rows = {key: _member(sub, count) for key, sub in space.spaces.items()}
        known = {key: row for key, row in rows.items() if row is not None}
        return spaces.Dict(known) if len(known) == len(rows) else None
    if (space.shape or ())[:1] != (count,):
        return None
    if isinstance(space, spaces.Box):
        return spaces.Box(space.low[0], space.high[0], dtype=space.dtype.type)
    if isinstance(space, spaces.MultiDiscrete):
        first = space.nvec[0]
        return spaces.Discrete(int(first)) if not first.shape else spaces.MultiDiscrete(first)
    return None


def _space_of(value: Any, count: int) -> gym.Space[Any] | None:
    """The space of one row of a batch of observations; None where it is no batch of numbers."""
    if isinstance(value, dict):
        rows = {key: _space_of(item, count) for key, item in value.items()}
        known = {key: row for key, row in rows.items() if row is not None}
        return spaces.Dict(known) if rows and len(known) == len(rows) else None
    array = np.asarray(value.cpu() if hasattr(value, "cpu") else value)
    if array.shape[:1] != (count,) or array.dtype.kind not in "fiub":
        return None
    low, high = (0, 255) if array.dtype == np.uint8 else (-np.inf, np.inf)
    if array.dtype.kind in "ib" and array.dtype != np.uint8:
        kind = array.dtype
        low, high = (0, 1) if kind == np.bool_ else (np.iinfo(kind).min, np.iinfo(kind).max)
    return spaces.Box(low, high, array.shape[1:], array.dtype.type)
