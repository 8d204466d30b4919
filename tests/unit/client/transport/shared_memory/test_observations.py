"""Which slot a batch is in, who may still write it, and what a hostile byte becomes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox.transport.shared_memory.observations import RING, ObservationSlab
from envhub_worker.protocol.shared_memory import slabs

COUNT = 2
BOX = spaces.Box(-1, 1, (3,), np.float32)
NESTED = spaces.Dict(
    {"seen": spaces.MultiBinary(4), "both": spaces.Tuple((BOX, spaces.Discrete(9)))}
)
MASK = spaces.Dict({"mask": spaces.Box(0, 1, (4,), np.bool_)})


@pytest.fixture
def slab_of() -> Iterator[Callable[..., ObservationSlab]]:
    """Makes one, which is closed afterwards."""
    made: list[ObservationSlab] = []

    def make(space: Any, slots: int = 1) -> ObservationSlab:
        layout = slabs.observation_layout(space, COUNT, slots)
        assert layout is not None
        made.append(ObservationSlab(space, layout))
        return made[-1]

    yield make
    for one in made:
        one.close()


def write(slab: ObservationSlab, value: int) -> None:
    """As runners do: this number, into every leaf of the chosen slot."""
    base = slab.chosen * slab.layout.slot_bytes
    memory = np.memmap(f"/proc/self/fd/{slab.fd}", np.uint8, "r+", shape=slab.layout.total_bytes)
    for leaf in slab.layout.leaves:
        slabs.view(memory, leaf, base=base)[...] = value


def test_one_slot_is_copied_out(slab_of: Callable[..., ObservationSlab]) -> None:
    """In the structure of the space; what comes later does not reach the caller's arrays."""
    slab = slab_of(NESTED)
    assert slab.choose() == 0
    write(slab, 1)
    first = slab.take()
    write(slab, 0)
    assert first["seen"].tolist() == [[1] * 4] * COUNT
    assert [leaf.shape for leaf in first["both"]] == [(COUNT, 3), (COUNT,)]
    assert [leaf.tolist() for leaf in first["both"]] == [[[1.0] * 3] * COUNT, [1] * COUNT]
    assert all(leaf.flags.owndata for leaf in (first["seen"], *first["both"]))


def test_a_slot_is_written_again_when_no_array_of_it_is_held(
    slab_of: Callable[..., ObservationSlab],
) -> None:
    """Views of views count; when all are held the batch is copied, and the lowest is hot."""
    slab = slab_of(BOX, RING + 1)
    held = []
    for number in range(1, RING + 1):
        assert slab.choose() == number
        write(slab, number)
        held.append(slab.take())
    assert slab.choose() == 0
    write(slab, 9)
    spare = slab.take()
    assert spare.flags.owndata
    assert [batch[0, 0] for batch in (*held, spare)] == [1, 2, 3, 4, 9]
    row = held[2][0][1:]
    held[2] = None
    assert slab.choose() == 0, "a view of it is held"
    del row
    assert slab.choose() == 3
    held[0] = None
    assert slab.choose() == 1
    slab.leave()
    assert slab.chosen == 0


@pytest.mark.parametrize("slots", [1, 2])
def test_a_hostile_byte_makes_no_third_boolean(
    slab_of: Callable[..., ObservationSlab], slots: int
) -> None:
    slab = slab_of(MASK, slots)
    slab.choose()
    layout = slab.layout
    memory = np.memmap(f"/proc/self/fd/{slab.fd}", np.uint8, "r+", shape=layout.total_bytes)
    memory[:] = 2
    mask = slab.take()["mask"]
    rewards, terminations, truncations = slab.results()
    for flags in (mask, terminations, truncations):
        assert flags.dtype == np.bool_
        assert set(flags.view(np.uint8).ravel().tolist()) == {1}
    assert rewards.shape == terminations.shape == truncations.shape == (COUNT,)
    memory[:] = 0
    assert terminations.all(), "they are copies"
    if slots == 1:
        assert mask.all()


def test_received_memory_is_shared_with_nobody() -> None:
    layout = slabs.observation_layout(BOX, COUNT, 1)
    assert layout is not None
    received = memoryview(bytearray(layout.total_bytes))
    slab = ObservationSlab(BOX, layout, received)
    slabs.view(received, layout.leaves[0])[...] = 3
    assert (slab.fd, slab.take().tolist()) == (-1, [[3.0] * 3] * COUNT)
