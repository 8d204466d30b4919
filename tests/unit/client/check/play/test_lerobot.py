"""Whether LeRobot's policies can play an environment."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox.check.play.probes import lerobot_lacks

PLAYABLE = spaces.Dict({"agent_pos": spaces.Box(-1, 1, (2,), np.float32)})
VECTOR = spaces.Box(-1, 1, (2,), np.float32)


def vector(observations: Any = PLAYABLE, actions: Any = VECTOR, *, limited: bool = True) -> Any:
    """What is asked of an environment."""

    def get_attr(name: str) -> tuple[int, ...]:
        if not limited:
            raise AttributeError(name)
        return (100,)

    return SimpleNamespace(
        single_observation_space=observations, single_action_space=actions, get_attr=get_attr
    )


def test_nothing_is_said_of_what_it_can_play() -> None:
    """State or pixels in a mapping, a vector as action, and an end."""
    assert list(lerobot_lacks(vector())) == []


@pytest.mark.parametrize(
    ("env", "lacking"),
    [
        (vector(VECTOR), "observations with agent_pos, environment_state or pixels, not a"),
        (vector(spaces.Dict({"image": VECTOR})), "not a Dict of image"),
        (vector(actions=spaces.Discrete(3)), r"a vector \(Box\) as action, not Discrete\(3\)"),
        (vector(actions=spaces.Box(0, 1, (2, 2))), r"not a Box of shape \(2, 2\)"),
        (vector(limited=False), "_max_episode_steps"),
    ],
)
def test_what_it_lacks_is_one_text(env: Any, lacking: str) -> None:
    """It names all that is missing."""
    [text] = lerobot_lacks(env)
    assert text.startswith("LeRobot cannot evaluate it, which needs ")
    assert re.search(lacking, text)
