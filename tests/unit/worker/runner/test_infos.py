"""Infos in the worker's own loop are Gymnasium's, and columns are the infos that they stand for."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import VectorEnv
from hypothesis import given
from hypothesis import strategies as st

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.shared_memory.slabs import columns_of
from envhub_worker.protocol.spaces.batches import join_pairs
from envhub_worker.runner.lane import InfoWriter
from tests.support.compare import assert_same

SCALARS = st.one_of(
    st.integers(-5, 5),
    st.floats(-1, 1),
    st.booleans(),
    st.floats(-1, 1).map(np.float64),
    st.floats(-1, 1, width=32).map(np.float32),
)
VALUES = st.one_of(
    SCALARS,
    st.text(max_size=3),
    st.none(),
    st.lists(st.integers(0, 3), max_size=2),
    st.lists(SCALARS, min_size=2, max_size=2).map(lambda two: np.array(two, np.float64)),
)
INFOS = st.dictionaries(
    st.sampled_from(["a", "b", "c", "final_obs"]),
    VALUES | st.dictionaries(st.sampled_from(["x", "y"]), VALUES, max_size=2),
    max_size=3,
)


class Oracle(VectorEnv[Any, Any, Any]):
    """Gymnasium's own way."""

    def join(self, infos: list[dict[str, Any]]) -> dict[str, Any]:
        self.num_envs = len(infos)
        joined: dict[str, Any] = {}
        for index, info in enumerate(infos):
            joined = self._add_info(joined, info, index)
        return joined


@given(st.lists(INFOS, min_size=1, max_size=4))
def test_infos_are_joined_as_gymnasium_joins_them(infos: list[dict[str, Any]]) -> None:
    pairs = [(index, info) for index, info in enumerate(infos) if info]
    try:
        expected = Oracle().join(infos)
    except Exception as error:
        with pytest.raises(type(error)):
            join_pairs(pairs, len(infos))
        return
    assert_same(expected, join_pairs(pairs, len(infos)))


class Slab:
    """The info area of a slab with both of its sides."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.memory = bytearray(slabs.INFO_BYTES)
        joined = partial(join_pairs, count=count)
        self.writer = InfoWriter(self.memory, 0, count, m.pack, joined)
        self.columns: Any = None
        self.outcomes: list[int] = []

    def cross(self, infos: list[dict[str, Any]]) -> dict[str, Any]:
        pairs = [(index, info) for index, info in enumerate(infos) if info]
        outcome, length = self.writer.write(pairs)
        self.outcomes.append(outcome)
        if outcome == slabs.COLUMNS:
            masks = {f"_{key}": np.ones(self.count, bool) for key in infos[0]}  # the client's own
            columns = {c.key: c.view(self.memory, 0).astype(c.dtype) for c in self.columns}
            return {**columns, **masks}
        message = m.unpack([bytes(self.memory[:length])])
        self.columns = columns_of(message.value)
        return message.value


@given(st.lists(st.lists(st.dictionaries(st.sampled_from("ab"), SCALARS), min_size=2, max_size=2)))
def test_infos_cross_a_slab_unchanged(steps: list[list[dict[str, Any]]]) -> None:
    """Whether they go encoded or as columns, the client has what Gymnasium would give."""
    slab = Slab(2)
    for infos in steps:
        if any(infos):
            assert_same(Oracle().join(infos), slab.cross(infos))


def test_the_same_small_dict_goes_as_columns() -> None:
    slab = Slab(2)
    for step in range(5):
        infos = [{"x": float(step + i), "is_success": bool(i)} for i in range(2)]
        assert_same(Oracle().join(infos), slab.cross(infos))
    assert slab.outcomes == [slabs.DONE, *[slabs.COLUMNS] * 4]


def test_another_type_ends_the_columns() -> None:
    """An int among floats decides another dtype in Gymnasium, so it goes encoded."""
    slab = Slab(1)
    for value in (1.0, 2.0, 3, 4.0):
        assert_same(Oracle().join([{"x": value}]), slab.cross([{"x": value}]))
    assert slab.outcomes == [slabs.DONE, slabs.COLUMNS, slabs.DONE, slabs.DONE]


@pytest.mark.parametrize(
    "infos",
    [
        {},
        {"a": np.array([None])},
        {"a": {"b": np.zeros(1)}},
        {3: np.zeros(1)},
        {"a": np.array(["x"])},
        {"a": np.zeros(slabs.INFO_BYTES)},
    ],
    ids=["empty", "objects", "nested", "number key", "text", "too large"],
)
def test_other_infos_have_no_columns(infos: dict[Any, Any]) -> None:
    assert columns_of(infos) is None
