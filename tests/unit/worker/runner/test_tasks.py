"""Spaces of a vector environment that names none of one sub-environment."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from envhub_worker.runner.tasks import derive_spaces, derived_space

ROWS = spaces.Box(-1, 1, (3, 2), np.float32)
ROW = spaces.Box(-1, 1, (2,), np.float32)


def vector(observation: Any, **attributes: Any) -> Any:
    """Three sub-environments whose resets observe this."""
    return SimpleNamespace(num_envs=3, reset=lambda: (observation, {}), **attributes)


@pytest.mark.parametrize(
    ("observation", "attributes", "expected"),
    [
        (np.zeros((3, 2), np.float32), {"observation_space": ROWS, "action_space": ROWS}, ROW),
        (np.zeros((3, 2), np.float32), {"observation_space": ROW, "action_space": ROW}, ROW),
        (
            {"a": np.zeros((3, 2), np.float32)},
            {"observation_space": spaces.Dict({"a": ROWS}), "action_space": ROWS},
            spaces.Dict({"a": ROW}),
        ),
        (
            np.zeros((3, 4), np.uint8),
            {"action_space": ROWS},
            spaces.Box(0, 255, (4,), np.uint8),
        ),
        (
            np.zeros((3, 1), np.int16),
            {"action_space": ROWS},
            spaces.Box(-(2**15), 2**15 - 1, (1,), np.int16),
        ),
    ],
)
def test_one_row_is_the_space_of_one(
    observation: Any, attributes: dict[str, Any], expected: spaces.Space[Any]
) -> None:
    """A declared space is batched if the first observation has its shape; else it is of one."""
    env = vector(observation, **attributes)
    assert derive_spaces(env) == ""
    assert derived_space(env, "observation_space") == expected
    assert derived_space(env, "action_space") == ROW
    assert vars(env)["action_space"] is attributes["action_space"]  # its own stay


def test_a_batch_of_choices_is_one_choice() -> None:
    choices = spaces.MultiDiscrete([5, 5, 5])
    env = vector(np.zeros(3, np.int64), observation_space=choices, action_space=choices)
    assert derive_spaces(env) == ""
    assert derived_space(env, "action_space") == spaces.Discrete(5)


@pytest.mark.parametrize(
    ("observation", "attributes", "missing"),
    [
        (np.zeros((2, 2)), {"action_space": ROWS}, "single_observation_space"),
        (np.array(["a", "b", "c"]), {"action_space": ROWS}, "single_observation_space"),
        ({}, {"action_space": ROWS}, "single_observation_space"),
        (np.zeros((3, 2)), {}, "single_action_space"),
    ],
)
def test_what_cannot_be_derived_is_named(
    observation: Any, attributes: dict[str, Any], missing: str
) -> None:
    env = vector(observation, **attributes)
    assert derive_spaces(env) == missing
    assert derived_space(env, "observation_space") is None


def test_what_it_has_is_not_asked_for() -> None:
    env = SimpleNamespace(num_envs=3, single_observation_space=ROW, single_action_space=ROW)
    assert derive_spaces(env) == ""
    assert derived_space(env, "action_space") is None
