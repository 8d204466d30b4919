"""Where everything lies in the fast lane's memory."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import batch_space

from envhub_worker.protocol import slabs

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


def extents(layout: slabs.Layout) -> list[tuple[int, int]]:
    """Start and end of everything in the reply slab, in order."""
    found = [(0, slabs.HEADER_BYTES), (layout.results, layout.results + layout.results_bytes)]
    for leaf in layout.observations:
        size = int(np.prod(leaf.shape)) * leaf.dtype.itemsize
        found.append((leaf.offset, leaf.offset + size))
    return [*found, (layout.infos, layout.infos + slabs.INFO_BYTES)]


@pytest.mark.parametrize("space", FIXED, ids=str)
@pytest.mark.parametrize("count", [1, 3, 64])
def test_nothing_in_a_slab_overlaps(space: gym.Space[Any], count: int) -> None:
    """Every area starts after the one before it has ended, aligned, and inside the slab."""
    layout = slabs.layout_of(space, space, count)
    assert layout is not None
    found = extents(layout)
    assert all(end <= start for (_, end), (start, _) in pairwise(found))
    assert all(start % slabs.LINE == 0 for start, _ in found)
    assert found[-1][1] <= layout.reply_bytes
    for leaf in layout.actions:
        assert leaf.offset + int(np.prod(leaf.shape)) * 8 <= layout.request_bytes


@pytest.mark.parametrize("space", FIXED, ids=str)
def test_a_batch_survives_its_leaves(space: gym.Space[Any]) -> None:
    """Written leaf by leaf into a slab and assembled again, a batch is what it was."""
    layout = slabs.layout_of(space, spaces.Discrete(2), 3)
    assert layout is not None
    batched = batch_space(space, 3)
    batched.seed(7)
    batch = batched.sample()
    memory = bytearray(layout.reply_bytes)
    views = [slabs.view(memory, leaf) for leaf in layout.observations]
    for view, leaf in zip(views, slabs.flatten(space, batch), strict=True):
        view[...] = leaf
    again = slabs.assembler(space)(views)
    assert gym.vector.utils.batch_space(space, 3).contains(again)
    for one, other in zip(slabs.flatten(space, again), slabs.flatten(space, batch), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("space", LOOSE, ids=str)
def test_a_space_without_a_fixed_layout_has_no_slab(space: gym.Space[Any]) -> None:
    """Text, sequences and graphs go as frames."""
    assert slabs.layout_of(space, BOX, 2) is None
    assert slabs.layout_of(BOX, space, 2) is None


def test_a_slab_over_the_limit_is_not_made() -> None:
    """Pinned memory has a bound; what is larger goes as frames."""
    huge = spaces.Box(0, 1, (slabs.MAX_SLAB_BYTES // 8, 2), np.float64)
    assert slabs.layout_of(huge, BOX, 1) is None


def test_too_many_leaves_have_no_slab() -> None:
    """The header has one word for the dtype of each action leaf."""
    many = spaces.Dict({str(i): spaces.Discrete(2) for i in range(slabs.MAX_LEAVES + 1)})
    assert slabs.layout_of(BOX, many, 1) is None


def test_every_action_dtype_has_one_code() -> None:
    """The code is the place in the table, on both sides."""
    assert len(slabs.DTYPE_CODES) == len(slabs.ACTION_DTYPES)
    for code, dtype in enumerate(slabs.ACTION_DTYPES):
        assert slabs.DTYPE_CODES[dtype] == code
        assert dtype.itemsize <= 8
