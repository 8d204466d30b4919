"""What LeRobot calls the features of an environment, from its spaces.

Followed: ``preprocess_observation`` of ``lerobot.envs.utils``, which decides what of an observation
a policy sees, and under which name.
"""

from __future__ import annotations

from typing import Any

from gymnasium import Space
from gymnasium.spaces import Box, Dict
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.utils.constants import (
    ACTION,
    OBS_ENV_STATE,
    OBS_IMAGE,
    OBS_IMAGES,
    OBS_STATE,
    OBS_STR,
)

_NAMED = {
    "agent_pos": (OBS_STATE, FeatureType.STATE),
    "environment_state": (OBS_ENV_STATE, FeatureType.ENV),
}
_NESTED = ("pixels", "robot_state", "policy", "camera_obs")


def features_of(
    observations: Space[Any], actions: Space[Any], *, others: bool
) -> tuple[dict[str, Any], dict[str, str]]:
    """``features`` and ``features_map`` of an ``EnvConfig``.

    Keys are those of an observation, or, for one of several cameras, what LeRobot calls it when it
    records. What LeRobot has no tensor for is left out: actions that are not a vector too, which
    its evaluation does not give.

    Args:
        observations: The space of one sub-environment's observations.
        actions: The space of its actions.
        others: Whether this LeRobot hands on vectors of other names.
    """
    found: dict[str, tuple[str, FeatureType, tuple[int, ...]]] = {}
    if isinstance(actions, Box) and len(actions.shape) == 1:
        found[ACTION] = (ACTION, FeatureType.ACTION, actions.shape)
    for name, space in observations.items() if isinstance(observations, Dict) else ():
        if name == "pixels":
            found |= _pixels(space)
        elif name in _NAMED and isinstance(space, Box):
            found[name] = (*_NAMED[name], space.shape)
        elif others and name not in _NESTED and isinstance(space, Box) and len(space.shape) == 1:
            found[name] = (f"{OBS_STR}.{name}", FeatureType.STATE, space.shape)
    features = {
        key: PolicyFeature(type=kind, shape=shape) for key, (_, kind, shape) in found.items()
    }
    return features, {key: policy_key for key, (policy_key, _, _) in found.items()}


def _pixels(space: Space[Any]) -> dict[str, tuple[str, FeatureType, tuple[int, ...]]]:
    """One camera, or several by their names; each (height, width, channels)."""
    if isinstance(space, Dict):
        cameras = {f"{OBS_IMAGES}.{name}": camera for name, camera in space.items()}
        return {
            key: (key, FeatureType.VISUAL, camera.shape)
            for key, camera in cameras.items()
            if isinstance(camera, Box) and len(camera.shape) == 3
        }
    if isinstance(space, Box) and len(space.shape) == 3:
        return {"pixels": (OBS_IMAGE, FeatureType.VISUAL, space.shape)}
    return {}
