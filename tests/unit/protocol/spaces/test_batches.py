"""Batches cut for shards and joined again: Gymnasium's own functions are the reference."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate
from hypothesis import given
from hypothesis import strategies as st

from envhub_worker.protocol.errors import MessageTooLargeError
from envhub_worker.protocol.spaces import batches
from tests.support.compare import assert_same

NODES = spaces.Graph(spaces.Box(-1, 1, (2,)), spaces.Discrete(3))
SINGLE_SPACES: dict[str, gym.Space[Any]] = {
    "box": spaces.Box(-1, 1, (2, 3), np.float32),
    "image": spaces.Box(0, 255, (4, 4, 3), np.uint8),
    "scalar box": spaces.Box(-1, 1, (), np.float64),
    "discrete": spaces.Discrete(5, start=2),
    "multi-discrete": spaces.MultiDiscrete([3, 4]),
    "multi-binary": spaces.MultiBinary((2, 2)),
    "text": spaces.Text(5),
    "graph": NODES,
    "sequence": spaces.Sequence(spaces.Discrete(4)),
    "sequence of graphs": spaces.Sequence(NODES),
    "stacked sequence": spaces.Sequence(spaces.Box(0, 1, (2,)), stack=True),
    "dict": spaces.Dict(
        {"b": spaces.Discrete(3), "a": spaces.Dict({"image": spaces.Box(0, 1, (2,))})}
    ),
    "tuple": spaces.Tuple((spaces.Discrete(3), spaces.Dict({"text": spaces.Text(3), "g": NODES}))),
}
NUM_ENVS = 5
SHARDS = st.integers(1, NUM_ENVS)
NAMES = st.sampled_from(sorted(SINGLE_SPACES))


def batch_of(space: gym.Space[Any], count: int, seed: int = 0) -> tuple[list[Any], Any]:
    """Some members of a space, and Gymnasium's batch of them."""
    space.seed(seed)
    members = [space.sample() for _ in range(count)]
    return members, concatenate(space, members, create_empty_array(space, count))


def parts_of(space: gym.Space[Any], members: list[Any], bounds: batches.Bounds) -> list[Any]:
    return [
        concatenate(space, members[start:stop], create_empty_array(space, stop - start))
        for start, stop in bounds
    ]


@given(NAMES, st.integers(1, 4))
def test_what_gymnasium_batches_is_a_batch(name: str, count: int) -> None:
    space = SINGLE_SPACES[name]
    assert batches.is_batch(batch_space(space, count), space, count)
    shaped = not isinstance(space, (spaces.Text, spaces.Graph, spaces.Sequence))
    assert batches.is_batch(batch_space(space, count), space, count + 1) != shaped


@pytest.mark.parametrize("name", sorted(SINGLE_SPACES))
def test_a_space_is_no_batch_of_itself(name: str) -> None:
    """Where a vector environment gives one space for both, as NVIDIA's wrapper does."""
    space = SINGLE_SPACES[name]
    known = not isinstance(space, (spaces.Text, spaces.Graph, spaces.Sequence))
    assert batches.is_batch(space, space, 3) != known


@given(st.integers(1, 200), st.data())
def test_bounds_cover_everybody_once_and_evenly(count: int, data: st.DataObject) -> None:
    parts = data.draw(st.integers(1, count))
    bounds = batches.even_bounds(count, parts)
    assert [index for start, stop in bounds for index in range(start, stop)] == list(range(count))
    sizes = [stop - start for start, stop in bounds]
    assert len(sizes) == parts
    assert 0 <= max(sizes) - min(sizes) <= 1


@given(NAMES, SHARDS, st.integers(0, 2**31))
def test_split_gives_each_shard_its_members(name: str, shards: int, seed: int) -> None:
    space = SINGLE_SPACES[name]
    members, batch = batch_of(space, NUM_ENVS, seed)
    bounds = batches.even_bounds(NUM_ENVS, shards)
    found = [
        member
        for part, (start, stop) in zip(batches.split(space, batch, bounds), bounds, strict=True)
        for member in iterate(batch_space(space, stop - start), part)
    ]
    assert_same(list(iterate(batch_space(space, NUM_ENVS), batch)), found)
    assert len(found) == len(members)


@given(NAMES, SHARDS, st.integers(0, 2**31))
def test_join_is_the_batch_of_all_members(name: str, shards: int, seed: int) -> None:
    space = SINGLE_SPACES[name]
    members, batch = batch_of(space, NUM_ENVS, seed)
    parts = parts_of(space, members, batches.even_bounds(NUM_ENVS, shards))
    assert_same(batch, batches.join(space, parts))


@pytest.mark.parametrize("name", SINGLE_SPACES)
def test_batches_conform_to_their_space(name: str) -> None:
    space = SINGLE_SPACES[name]
    _, batch = batch_of(space, 3)
    assert batches.conforms(space, batch, 3)
    assert not batches.conforms(space, batch, 2)


THREE = np.zeros(3, np.int64)


@pytest.mark.parametrize(
    ("name", "batch"),
    [
        *(("box", np.zeros(*shape)) for shape in (((3, 2, 3),), ((3, 3, 2), np.float32))),
        *(("box", np.zeros((3, 2, 3), np.float32).tolist()), ("box", None)),
        *(("scalar box", np.zeros((3, 1))), ("discrete", np.zeros(3, np.int32))),
        *(("discrete", np.zeros((3, 1), np.int64)), ("text", ["a", "b", "c"]), ("text", "abc")),
        *(("dict", {"b": THREE}), ("dict", (THREE, {}))),
        ("dict", {"b": THREE, "a": {"image": np.zeros((3, 2), np.float64)}}),
        *(("tuple", (THREE,)), ("tuple", [THREE, {}])),
        ("tuple", (THREE, {"text": ("a", "b", "c"), "g": ("a",)})),
    ],
)
def test_other_structures_shapes_and_dtypes_do_not_conform(name: str, batch: object) -> None:
    assert not batches.conforms(SINGLE_SPACES[name], batch, 3)


def test_values_outside_the_bounds_conform() -> None:
    assert batches.conforms(SINGLE_SPACES["box"], np.full((1, 2, 3), 9, np.float32), 1)


@pytest.mark.parametrize("name", SINGLE_SPACES)
def test_members_get_their_classes_back(name: str) -> None:
    """A graph crosses as a plain tuple, and comes out as Gymnasium's own class."""
    space = SINGLE_SPACES[name]
    _, batch = batch_of(space, 3)
    assert_same(batch, batches.restore_batch(space, without_classes(batch)))
    [member], _ = batch_of(space, 1)
    assert_same(member, batches.restore(space, without_classes(member)))


def without_classes(value: Any) -> Any:
    """A value as it comes off the wire: named tuples are plain ones."""
    if isinstance(value, dict):
        return {key: without_classes(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return tuple(map(without_classes, value))
    return value


@pytest.mark.parametrize("name", SINGLE_SPACES)
def test_only_graphs_need_their_classes_back(name: str) -> None:
    expected = name in {"graph", "sequence of graphs", "tuple"}
    assert batches.restores(SINGLE_SPACES[name]) is expected


@pytest.mark.parametrize("member", [None, 3, (1, 2), {"text": 1}, ({}, {}, {}, {})])
@pytest.mark.parametrize("name", ["graph", "dict", "tuple", "sequence of graphs"])
def test_lies_about_members_are_left_as_they_are(name: str, member: object) -> None:
    """``final_obs`` is not checked against the space, nor is a batch of an own class; restoring
    them raises nothing.
    """
    assert batches.restore(SINGLE_SPACES[name], member) == member
    assert batches.restore_batch(SINGLE_SPACES[name], member) == member


def test_few_bytes_make_no_large_column() -> None:
    """One value of each sub-environment is as long as the first one's, and is counted so, as masks
    and final observations are; what all have sent is joined, whatever it takes."""
    row = np.zeros(1000, np.uint8)
    for small in ({str(key): {} for key in range(9)}, {"a": {"final_obs": 0}}):
        with pytest.raises(MessageTooLargeError, match="more than 1500 bytes"):
            batches.join_pairs([(0, small)], 64, 1500)
    for info in ({"a": row}, {"x": {"a": row}}):
        assert batches.join_pairs([(index, info) for index in range(64)], 64, 1100).keys()
        assert batches.join_pairs([(0, info)], 3, 2100).keys()
        with pytest.raises(MessageTooLargeError, match="more than 1900 bytes"):
            batches.join_pairs([(0, info)], 3, 1900)
