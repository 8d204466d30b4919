"""Members whose sizes vary, written into a slot and read from it again."""

import mmap
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from envhub_sandbox.transport.values import to_tensor
from envhub_worker.protocol.messages.forms import IrregularError
from envhub_worker.protocol.shared_memory.columns import StepColumns
from tests.support.compare import assert_same

ROOM = 1 << 20
BOX = spaces.Box(-1, 1, (2, 3), np.float32)
GRAPH = spaces.Graph(spaces.Box(-1, 1, (2,)), spaces.Discrete(3))
MAPPING = spaces.Dict(b=spaces.Discrete(4), a=spaces.Tuple([BOX, spaces.Text(5)]))
VARYING = [
    spaces.Sequence(BOX),
    spaces.Sequence(BOX, stack=True),
    spaces.Sequence(spaces.Dict(a=BOX, b=spaces.Discrete(3)), stack=True),
    spaces.Sequence(spaces.Sequence(MAPPING)),
    spaces.Graph(spaces.Discrete(3), None),
    spaces.Sequence(GRAPH),
    spaces.OneOf([spaces.Sequence(GRAPH), spaces.Text(4), spaces.Discrete(3)]),
]


@pytest.mark.parametrize("space", VARYING, ids=repr)
@pytest.mark.parametrize("count", [1, 3])
def test_members_of_other_sizes_are_columns_of_the_first_ones(space: Any, count: int) -> None:
    """Also beside arrays of a fixed layout; with the same classes, dtypes and owners."""
    both = spaces.Dict(image=BOX, varies=space)
    both.seed(3)

    def batch() -> Any:
        image = np.stack([both["image"].sample() for _ in range(count)])
        return {"image": image, "varies": tuple(both["varies"].sample() for _ in range(count))}

    memory, columns = bytearray(ROOM), StepColumns([batch(), 0.5], ROOM, both)
    for _ in range(20):
        observation = batch()
        packed = columns.write([observation, 0.25], memory, 0)
        read = columns.read(memory, 0, packed, to_tensor)
        memory[:] = bytes(ROOM)
        assert_same(read, [observation, 0.25])


def test_a_slot_is_held_by_what_was_read_of_it_alone() -> None:
    """And the bytes that were read are counted."""
    columns = StepColumns([((),)], ROOM, spaces.Sequence(spaces.Box(-1, 1, (20_000,))))
    slot = mmap.mmap(-1, ROOM)
    packed = columns.write([((np.zeros(20_000, np.float32),) * 2,)], slot, 0)
    unheld = sys.getrefcount(slot)
    read = columns.read(slot, 0, packed, to_tensor, slot)
    assert sys.getrefcount(slot) > unheld
    assert columns.read_bytes == read[0][0][0].nbytes * 2
    del read
    assert sys.getrefcount(slot) == unheld


UNFIT: dict[str, Callable[[], Any]] = {
    "a list": lambda: ([np.zeros((2, 3), np.float32)],),
    "another shape": lambda: ((np.zeros((3, 2), np.float32), np.zeros((2, 3), np.float32)),),
    "two dtypes": lambda: ((np.zeros((2, 3), np.float32), np.zeros((2, 3), np.float16)),),
    "a dtype without columns": lambda: ((np.zeros((2, 3), object),),),
    "a subclass": lambda: ((np.zeros((2, 3), np.float32).view(np.recarray),),),
    "two members": lambda: ((), ()),
    "more than the slot": lambda: ((np.zeros((2, 3), np.float32),) * 200,),
}


@pytest.mark.parametrize("kind", UNFIT)
def test_other_members_are_no_columns(kind: str) -> None:
    columns = StepColumns([((),)], 4096, spaces.Sequence(BOX))
    with pytest.raises(IrregularError):
        columns.write([UNFIT[kind]()], bytearray(4096), 0)


@pytest.mark.parametrize("empty", [spaces.Tuple([]), spaces.Box(0, 1, (0,))], ids=repr)
def test_members_without_bytes_have_no_bound_and_no_columns_of_their_own(empty: Any) -> None:
    columns = StepColumns([((),)], 4096, spaces.Sequence(empty))
    with pytest.raises(IrregularError):
        columns.write([((empty.sample(),),)], bytearray(4096), 0)
