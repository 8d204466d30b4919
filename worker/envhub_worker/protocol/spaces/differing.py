"""Gymnasium's error for a task whose sub-environments have different spaces: the same text for one
process and many. Followed: ``SyncVectorEnv.__init__`` and ``AsyncVectorEnv._check_spaces`` of 1.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym

Pair = tuple[gym.Space[Any], gym.Space[Any]]
"""The observation space and the action space of one sub-environment."""
_INSTEAD = "If this is intentional, use `observation_mode='different'` instead."


def differing(sync: bool, pairs: Sequence[Pair]) -> str:
    """Returns the text of Gymnasium's ``RuntimeError``; "" if all spaces equal the first's.
    ``sync``: whether ``SyncVectorEnv`` would raise it.
    """
    observation, action = pairs[0]
    if sync:
        return next(filter(None, (_other(pairs[0], pair) for pair in pairs)), "")
    if any(pair[0] != observation for pair in pairs):
        return (
            "AsyncVectorEnv(..., observation_mode='same') however some of the sub-environments "
            f"observation spaces are not equivalent. {_INSTEAD}"
        )
    if any(pair[1] != action for pair in pairs):
        return (
            f"Some environments have an action space different from `{action}`. "
            "In order to batch actions, the action spaces from all environments must be equal."
        )
    return ""


def _other(first: Pair, pair: Pair) -> str:
    if pair[0] != first[0]:
        return (
            "SyncVectorEnv(..., observation_mode='same') however the sub-environments observation "
            f"spaces are not equivalent. single_observation_space={first[0]}, "
            f"sub-environment observation_space={pair[0]}. {_INSTEAD}"
        )
    if pair[1] != first[1]:
        return (
            "Sub-environment action space doesn't make the `single_action_space`, "
            f"action_space={pair[1]}, single_action_space={first[1]}"
        )
    return ""
