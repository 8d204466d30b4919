"""Actions: what the space could mean is taken as it is, everything else is refused here."""

import types
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import CustomSpaceError
from gymnasium.vector.utils import batch_space, iterate
from hypothesis import given
from hypothesis import strategies as st

from envhub_sandbox.errors import ActionError, ActionTypeError
from envhub_sandbox.vector.actions import batch_of
from tests.support.compare import assert_same

DISCRETE = spaces.Discrete(3)
BOX = spaces.Box(-1, 1, (2,), np.float32)
IMAGE = spaces.Box(0, 255, (2, 2), np.uint8)
DICT = spaces.Dict({"move": BOX, "grip": DISCRETE})
TUPLE = spaces.Tuple((DISCRETE, spaces.Dict({"x": BOX})))
TEXT = spaces.Text(5)
SINGLE_SPACES: dict[str, gym.Space[Any]] = {
    "discrete": DISCRETE,
    "box": BOX,
    "image": IMAGE,
    "scalar": spaces.Box(-1, 1, ()),
    "multi-discrete": spaces.MultiDiscrete([3, 4]),
    "multi-binary": spaces.MultiBinary(3),
    "dict": DICT,
    "tuple": TUPLE,
    "text": TEXT,
    "sequence": spaces.Sequence(DISCRETE),
}


@given(st.sampled_from(sorted(SINGLE_SPACES)), st.integers(1, 4), st.integers(0, 2**31))
def test_samples_of_the_batched_space_stay_as_they_are(name: str, count: int, seed: int) -> None:
    """``env.action_space.sample()`` is always a batch."""
    space = SINGLE_SPACES[name]
    batched = batch_space(space, count)
    batched.seed(seed)
    sample = batched.sample()
    assert_same(sample, batch_of(space, sample, count))


@pytest.mark.parametrize(
    ("space", "value", "expected"),
    [
        (DISCRETE, [0, 2], [0, 2]),
        (DISCRETE, (0, 2), [0, 2]),
        (DISCRETE, [7, -1], [7, -1]),  # only shapes and kinds of numbers are looked at
        (spaces.Box(0, 1, (0,), np.int16), [[], []], [[], []]),
        (DISCRETE, np.array([0, 2], np.int8), np.array([0, 2], np.int8)),
        (DISCRETE, np.array([False, True]), np.array([False, True])),
        (BOX, [[0.5, 1], [0, 0]], np.array([[0.5, 1], [0, 0]])),
        (BOX, np.zeros((2, 2), np.float64), np.zeros((2, 2), np.float64)),
        (BOX, np.zeros((2, 2), np.int64), np.zeros((2, 2), np.int64)),
        (BOX, [np.zeros(2), np.ones(2)], np.array([[0.0, 0], [1, 1]])),
        (TEXT, ["a", "b"], ("a", "b")),
        (TUPLE, [[0, 1], {"x": np.zeros((2, 2))}], ([0, 1], {"x": np.zeros((2, 2))})),
    ],
)
def test_lists_and_other_dtypes_are_taken(space: gym.Space[Any], value: Any, expected: Any) -> None:
    """Dtypes stay as they are: that is what an environment in this process would see."""
    assert_same(expected, batch_of(space, value, 2))
    mapping = types.MappingProxyType({"grip": [0, 1], "move": np.zeros((2, 2)), "more": 1})
    made = batch_of(DICT, mapping, 2)
    order = [key for key in mapping if key in DICT.spaces]
    assert (type(made), list(made)) == (dict, order), "which a repository's own class sees"


@pytest.mark.parametrize("name", sorted({*SINGLE_SPACES} - {"discrete", "dict", "tuple"}))
def test_without_a_count_the_space_is_that_of_the_whole_batch(name: str) -> None:
    space = SINGLE_SPACES[name]
    sample = space.sample()
    assert_same(sample, batch_of(space, sample, None))


@pytest.mark.parametrize(
    ("space", "value", "complaint"),
    [
        (DISCRETE, [0, 1, 2], r"int64 of shape \(2,\).*got int64 of shape \(3,\)"),
        (DISCRETE, 1, r"got int64 of shape \(\)"),
        (DISCRETE, [0.5, 1.0], "got float64"),
        (DISCRETE, ["0", "1"], "got <U1"),
        (DISCRETE, [[0], [1]], r"got int64 of shape \(2, 1\)"),
        (BOX, np.zeros((2, 3), np.float32), r"float32 of shape \(2, 2\).*got .* \(2, 3\)"),
        (BOX, np.full((2, 2), None), "got object"),
        (BOX, [[0.5], [1, 2]], "not a batch for"),
        (IMAGE, np.zeros((2, 2, 2), np.float32), "got float32"),
        (DICT, [0, 1], "expected a mapping .*, got builtins.list"),
        (DICT, {"move": np.zeros((2, 2))}, "'grip'. missing"),
        (DICT, {"move": np.zeros((2, 2)), "grip": [0]}, r"actions\['grip'\]: expected"),
        (TUPLE, ([0, 1],), "expected a tuple of 2 batches .*, got builtins.tuple"),
        (TUPLE, ([0, 1], {"x": np.zeros(2)}), r"actions\[1\]\['x'\]: expected"),
        (TEXT, ["a"], "expected 2 members of .*, got 1"),
        (TEXT, 5, "expected 2 members of .*, got builtins.int"),
    ],
)
def test_what_does_not_fit_is_refused(space: gym.Space[Any], value: Any, complaint: str) -> None:
    with pytest.raises(ActionError, match=complaint) as caught:
        batch_of(space, value, 2)
    assert isinstance(caught.value, ValueError)


def test_objects_that_fail_to_be_arrays_are_refused() -> None:
    class Broken:
        def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
            raise OSError("no")

    with pytest.raises(ActionError, match=r"Broken is not a batch for .*: no") as caught:
        batch_of(BOX, Broken(), 2)
    assert isinstance(caught.value.__cause__, OSError)


@pytest.mark.parametrize("value", [5, 1.5, None])
def test_a_scalar_for_members_is_gymnasiums_error_too(value: Any) -> None:
    """Code that catches what ``SyncVectorEnv`` raises catches ours."""
    for space in (spaces.Text(3), spaces.Graph(spaces.Discrete(2), None)):
        with pytest.raises(CustomSpaceError):
            list(iterate(batch_space(space, 2), value))
        with pytest.raises(CustomSpaceError) as caught:
            batch_of(space, value, 2)
        assert isinstance(caught.value, ActionTypeError)
