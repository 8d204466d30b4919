"""Describes what has no form of its own on the wire, and yet can be made again on the other side.

Runs in the jail; the client checks what it says.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from envhub_worker.protocol.codec.kinds import GENERATOR, SPACE, SPEC
from envhub_worker.protocol.errors import EnvHubError
from envhub_worker.protocol.spaces.seeded import BIT_GENERATORS
from envhub_worker.protocol.spaces.spaces import encode_space

SPEC_FIELDS = ("id", "max_episode_steps", "reward_threshold", "nondeterministic")


def described(value: object) -> tuple[int, object] | None:
    """What kind of thing it is, and the plain values that it is made of; None if it is no such."""
    try:
        if isinstance(value, gym.Space):
            return SPACE, encode_space(value, seeded=True)
        if isinstance(value, EnvSpec):
            return SPEC, facts_of(value)
        if type(value) is np.random.Generator and type(value.bit_generator) in BIT_GENERATORS:
            return GENERATOR, value.bit_generator.state
    except (AttributeError, TypeError, ValueError, EnvHubError):
        pass  # a subclass that is half of one: then its repr has to do
    return None


def facts_of(spec: Any) -> dict[str, Any]:
    """What a spec says about the environment, and nothing of how it is made."""
    return {name: getattr(spec, name, None) for name in SPEC_FIELDS}
