"""Checks whether the observations of a play are members of their space, value by value.

The client checks shapes, dtypes and structures at every step; only ``check`` compares values,
because many environments leave their own bounds and can still be trained on.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv

from envhub_worker.protocol.codec.inert import one_line
from envhub_worker.protocol.spaces import batches
from envhub_worker.protocol.spaces.spaces import ARRAY_SPACES, OpaqueSpace

_SHOWN = 200


class OutsideSpaceError(Exception):
    """An observation is outside its space."""


def check_observations(
    env: VectorEnv[Any, Any, Any], operation: str, observations: Any, final_obs: Any = None
) -> None:
    """Raise ``OutsideSpaceError`` if an observation, or one in ``final_obs``, is outside its space.
    Trust: the values are the worker's.
    """
    single, batched = env.single_observation_space, env.observation_space
    if not batches.is_batch(batched, single, env.num_envs):  # the repository's own vector class
        _check(batched, operation, {0: observations})
    elif isinstance(single, OpaqueSpace):
        return  # this process cannot test membership
    else:
        try:
            each = batches.members(single, batched, observations, env.num_envs)
            members = dict(enumerate(each))
        except Exception as error:  # from the repository's own vector class
            seen = batches.shown(observations)
            text = f"{operation} returned {seen}, which is no batch of observations for {batched}"
            raise OutsideSpaceError(text) from error
        _check(single, operation, members)
    if isinstance(final_obs, np.ndarray) and final_obs.dtype == object:
        ended = {index: value for index, value in enumerate(final_obs) if value is not None}
        _check(single, "the last step of an episode", ended)


def _check(space: gym.Space[Any], operation: str, observations: Mapping[int, Any]) -> None:
    for index, observation in observations.items():
        if not holds(space, observation):
            is_space = isinstance(observation, gym.Space)
            seen = batches.shown(observation) if is_space else one_line(repr(observation), _SHOWN)
            raise OutsideSpaceError(
                f"{operation} returned an observation outside its space: sub-environment {index} "
                f"gave {seen}, which is not in {space}"
            )


def holds(space: gym.Space[Any], member: Any) -> bool:
    """Tells whether a value is in a space; numbers of another dtype count by their value."""
    if isinstance(space, OpaqueSpace):
        return True
    if isinstance(space, spaces.Dict):
        if not isinstance(member, dict) or member.keys() != space.spaces.keys():
            return False
        return all(holds(sub, member[key]) for key, sub in space.spaces.items())
    if isinstance(space, spaces.Tuple):
        if not isinstance(member, tuple) or len(member) != len(space.spaces):
            return False
        return all(map(holds, space.spaces, member))
    try:
        if isinstance(space, ARRAY_SPACES):
            member = np.asarray(member)
            if member.dtype != space.dtype and np.can_cast(member.dtype, space.dtype, "same_kind"):
                member = member.astype(space.dtype)
        return bool(space.contains(member))
    except (AttributeError, TypeError, ValueError):
        return False
