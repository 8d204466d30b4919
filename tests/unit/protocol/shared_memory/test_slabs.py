"""Where everything lies in the fast lane's memory."""

from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import batch_space

from envhub_worker.protocol.shared_memory import slabs

BOX = spaces.Box(-1, 1, (3,), np.float32)
NESTED = spaces.Dict(
    {
        "z": spaces.Box(0, 255, (4, 5, 3), np.uint8),
        "a": spaces.Tuple((spaces.Discrete(3), spaces.MultiBinary(7))),
        "m": spaces.Dict({"zero_d": spaces.Box(-1, 1, (), np.float64)}),
    }
)
FIXED = [BOX, spaces.Discrete(4), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(5), NESTED]
LOOSE = [
    spaces.Text(5),
    spaces.Sequence(BOX),
    spaces.Graph(BOX, None),
    spaces.Dict({"a": BOX, "t": spaces.Text(3)}),
    spaces.Tuple((BOX, spaces.Sequence(BOX))),
]


def sizes(leaves: tuple[slabs.Leaf, ...]) -> list[tuple[int, int]]:
    found = []
    for leaf in leaves:
        size = int(np.prod(leaf.shape)) * leaf.dtype.itemsize
        found.append((leaf.offset, leaf.offset + size))
    return found


def assert_apart(areas: list[tuple[int, int]], total: int) -> None:
    assert all(end <= start for (_, end), (start, _) in pairwise(areas))
    assert all(start % slabs.LINE == 0 for start, _ in areas)
    assert areas[-1][1] <= total


@pytest.mark.parametrize("space", FIXED, ids=str)
@pytest.mark.parametrize("count", [1, 3, 64])
def test_nothing_in_a_slab_overlaps(space: gym.Space[Any], count: int) -> None:
    layout = slabs.layout_of(space, count)
    observed = slabs.observation_layout(space, count, 3)
    infos = (slabs.INFOS, slabs.INFOS + slabs.INFO_BYTES)
    assert_apart([(0, slabs.HEADER_BYTES), infos], slabs.REPLY_BYTES)
    results = (observed.results, observed.results + 10 * count)
    assert_apart([(0, 3 * observed.slot_bytes), results], observed.total_bytes)
    assert_apart(sizes(observed.leaves), observed.slot_bytes)
    assert observed.slot_bytes % slabs.LINE == 0
    assert layout.actions[0].offset >= slabs.HEADER_BYTES
    for leaf in layout.actions:  # an action may come in a wider dtype than its space's
        assert leaf.offset + int(np.prod(leaf.shape)) * 8 <= layout.request_bytes


@pytest.mark.parametrize("space", FIXED, ids=str)
def test_a_batch_survives_its_leaves(space: gym.Space[Any]) -> None:
    layout = slabs.observation_layout(space, 3, 2)
    batched = batch_space(space, 3)
    batched.seed(7)
    batch = batched.sample()
    memory = bytearray(2 * layout.slot_bytes)
    views = [slabs.view(memory, leaf, base=layout.slot_bytes) for leaf in layout.leaves]
    for view, leaf in zip(views, slabs.flatten(space, batch), strict=True):
        view[...] = leaf
    assert not any(memory[: layout.slot_bytes])
    again = slabs.assembler(space)(views)
    assert batched.contains(again)
    for one, other in zip(slabs.flatten(space, again), slabs.flatten(space, batch), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("space", LOOSE, ids=str)
def test_a_space_without_a_fixed_layout_has_no_slab(space: gym.Space[Any]) -> None:
    assert slabs.layout_of(space, 2) is None
    assert slabs.observation_layout(space, 2, 1) is None


def test_a_slab_over_the_limit_is_not_made() -> None:
    pair = spaces.Box(0, 1, (2,), np.float64)
    assert slabs.layout_of(pair, slabs.MAX_SLAB_BYTES // 8) is None
    assert slabs.observation_layout(pair, slabs.MAX_SLAB_BYTES // 8, 1) is None


def test_too_many_leaves_have_no_slab() -> None:
    many = spaces.Dict({str(i): spaces.Discrete(2) for i in range(slabs.MAX_LEAVES + 1)})
    assert slabs.layout_of(many, 1) is None


def test_a_step_is_its_arrays() -> None:
    layout, observed = slabs.layout_of(BOX, 4), slabs.observation_layout(NESTED, 4, 3)
    assert layout.action_bytes == 4 * 3 * 4
    assert observed.batch_bytes == 4 * (60 + 8 + 7 + 8 + 8 + 1 + 1)


@pytest.mark.parametrize("kind", ["O", "U3", "S3", "M8[s]", "V8", "g", ">i4"])
def test_only_numbers_have_columns(kind: str) -> None:
    """An array of objects over memory that a jail writes would be pointers of its choice, and what
    is sent in another dtype would be read in that."""
    assert slabs.columns_of({"a": np.zeros(2)})
    assert slabs.columns_of({"a": np.zeros(2), "b": np.zeros(2, kind)}) is None
