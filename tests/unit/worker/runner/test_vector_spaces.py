"""Spaces that a vector environment does not declare, or declares the same for one and for all."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import batch_space

from envhub_worker.runner.vector_spaces import MissingSpaceError, VectorSpaces, row_of, spaces_of

Space = spaces.Space[Any]
ROWS = spaces.Box(-1, 1, (3, 2), np.float32)
ROW = spaces.Box(-1, 1, (2,), np.float32)
SEEN = np.zeros((3, 2), np.float32)


def vector(observation: Any, **attributes: Any) -> Any:
    return SimpleNamespace(num_envs=3, reset=lambda: (observation, {}), **attributes)


def one_space(space: Space, action: Space) -> dict[str, Space]:
    return {
        "single_observation_space": space,
        "observation_space": space,
        "single_action_space": action,
        "action_space": action,
    }


@pytest.mark.parametrize(
    ("observation", "attributes", "expected"),
    [
        (SEEN, {"observation_space": ROWS, "action_space": ROWS}, ROW),
        (SEEN, {"observation_space": ROW, "action_space": ROW}, ROW),
        (
            {"a": SEEN},
            {"observation_space": spaces.Dict({"a": ROWS}), "action_space": ROWS},
            spaces.Dict({"a": ROW}),
        ),
        (
            (SEEN, np.zeros(3, np.int64)),
            {
                "observation_space": spaces.Tuple((ROWS, spaces.MultiDiscrete([4, 4, 4]))),
                "action_space": ROWS,
            },
            spaces.Tuple((ROW, spaces.Discrete(4))),
        ),
        (np.zeros((3, 4), np.uint8), {"action_space": ROWS}, spaces.Box(0, 255, (4,), np.uint8)),
        (
            np.zeros((3, 1), np.int16),
            {"action_space": ROWS},
            spaces.Box(-(2**15), 2**15 - 1, (1,), np.int16),
        ),
        (SEEN, {"envs": [SimpleNamespace(observation_space=ROW, action_space=ROW)]}, ROW),
    ],
)
def test_one_row_is_of_one(observation: Any, attributes: dict[str, Any], expected: Space) -> None:
    """A declared space is batched if the first observation has its shape; else it is of one."""
    known = spaces_of(vector(observation, **attributes), {})
    assert known.single_observation_space == expected
    assert known.observation_space == batch_space(expected, 3)
    assert known.single_action_space == ROW
    assert known.action_space == ROWS


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1, 1, (2,)),
        spaces.Box(-1, 1, (1,)),
        spaces.Box(-1, 1, (3, 1)),
        spaces.Discrete(5, start=2),
        spaces.MultiDiscrete([4, 5, 6]),
        spaces.MultiBinary(3),
        spaces.Text(4),
        spaces.Dict(a=spaces.Box(-1, 1, (1, 3)), b=spaces.Tuple((spaces.Discrete(2),))),
    ],
    ids=str,
)
def test_the_first_observation_tells_one_from_the_batch(count: int, space: Space) -> None:
    """Of a space that is declared twice: as LeRobot's lazy vector, and as Isaac Lab Arena."""
    batch = batch_space(space, count)
    of_one, of_all = (vector(batch.sample(), **one_space(s, s)) for s in (space, batch))
    of_one.num_envs = of_all.num_envs = count
    known = spaces_of(of_one, {})
    assert (known.single_observation_space, known.single_action_space) == (space, space)
    assert (known.observation_space, known.action_space) == (batch, batch)
    known = spaces_of(of_all, {})
    assert known == VectorSpaces(batch, batch, batch, batch)


def test_a_shape_that_is_not_the_spaces_tells_by_its_dimensions() -> None:
    known = spaces_of(vector(np.zeros((3, 5)), **one_space(ROW, ROW)), {})
    assert (known.single_action_space, known.action_space) == (ROW, ROWS)


def test_a_reset_that_fails_is_the_callers() -> None:
    def reset() -> Any:
        raise KeyError("options")

    env = SimpleNamespace(num_envs=3, reset=reset, **one_space(ROWS, ROWS))
    assert spaces_of(env, {}) == VectorSpaces(ROWS, ROWS, ROWS, ROWS)


def test_an_action_space_stands_for_itself_where_observations_are_known() -> None:
    """No reset is needed; a batch of choices is one choice, a Box of joints is of one."""
    known: dict[str, Any] = {"single_observation_space": ROW, "observation_space": ROWS}
    for action, single in (
        (spaces.MultiDiscrete([5, 5, 5]), spaces.Discrete(5)),
        (spaces.Box(-1, 1, (3,)), spaces.Box(-1, 1, (3,))),
        (spaces.MultiDiscrete([5, 6, 7]), spaces.MultiDiscrete([5, 6, 7])),
    ):
        env = SimpleNamespace(num_envs=3, action_space=action, **known)
        assert spaces_of(env, {}).single_action_space == single
    same = SimpleNamespace(num_envs=3, single_action_space=ROW, action_space=ROW, **known)
    assert spaces_of(same, {}).action_space == ROWS


def test_of_a_class_only_the_first_is_reset() -> None:
    """A suite of lazy vector environments would start all their processes."""
    sides: dict[Any, bool] = {}
    for observation in (SEEN, None):
        env = vector(observation, **one_space(ROW, ROW))
        assert spaces_of(env, sides).action_space == ROWS


@pytest.mark.parametrize(
    ("observation", "attributes", "missing"),
    [
        (np.zeros((2, 2)), {"action_space": ROWS}, "single_observation_space"),
        (np.array(["a", "b", "c"]), {"action_space": ROWS}, "single_observation_space"),
        ({}, {"action_space": ROWS}, "single_observation_space"),
        (np.zeros((3, 2)), {}, "single_action_space"),
    ],
)
def test_the_underived_is_named(observation: Any, attributes: dict[str, Any], missing: str) -> None:
    with pytest.raises(MissingSpaceError, match=missing):
        spaces_of(vector(observation, **attributes), {})


def test_what_it_has_is_not_asked_for() -> None:
    env = SimpleNamespace(num_envs=3, single_observation_space=ROW, single_action_space=ROW)
    assert spaces_of(env, {}).action_space == ROWS


@pytest.mark.parametrize(
    ("batch", "row"),
    [
        (spaces.MultiBinary((3, 4, 5)), spaces.MultiBinary((4, 5))),
        (
            spaces.MultiDiscrete(np.array([[4, 5]] * 3), start=np.array([[1, 2]] * 3)),
            spaces.MultiDiscrete([4, 5], start=[1, 2]),
        ),
        (spaces.Tuple([spaces.Text(2)] * 3), spaces.Text(2)),
        (spaces.Dict(), None),
        (spaces.MultiDiscrete([4, 5, 6]), None),
    ],
    ids=str,
)
def test_a_batch_has_rows(batch: Space, row: Space | None) -> None:
    assert row_of(batch, 3) == row
