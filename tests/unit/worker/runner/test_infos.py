"""Infos in the worker's own loop are Gymnasium's, and columns are the infos that they stand for."""

from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from hypothesis import given
from hypothesis import strategies as st

from envhub_sandbox.transport.shared_memory.client_slabs import ShardSlabs
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.messages.forms import IrregularError
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.shared_memory.columns import StepColumns
from envhub_worker.protocol.shared_memory.slabs import columns_of
from envhub_worker.protocol.spaces.batches import join_pairs
from envhub_worker.runner.lane import Forms, InfoWriter
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
    """The slabs of a shard with both of their sides; a server brings only a part of them."""

    def __init__(self, count: int, *, served: bool = False) -> None:
        layout = slabs.layout_of(spaces.Discrete(2), count)
        assert layout is not None
        self.ours, self.theirs = bytearray(slabs.REPLY_BYTES), bytearray(slabs.REPLY_BYTES)
        if not served:
            self.ours = self.theirs
        request = bytearray(layout.request_bytes)
        self.asked, self.told = slabs.words(request), slabs.words(self.ours)
        self.client = ShardSlabs(layout, request, memoryview(self.ours))
        joined = partial(join_pairs, count=count)
        self.forms = Forms(self.asked, slabs.words(self.theirs), slabs.INFO_BYTES)
        self.writer = InfoWriter(self.theirs, count, m.pack, joined, self.forms)
        self.outcomes: list[int] = []

    def cross(self, infos: list[dict[str, Any]]) -> dict[str, Any]:
        pairs = [(index, info) for index, info in enumerate(infos) if info]
        self.asked[slabs.SEQUENCE] += 1
        outcome, length = self.writer.write(pairs)
        self.outcomes.append(outcome)
        area = slice(slabs.INFOS, slabs.ANSWER)
        self.ours[area] = self.theirs[area]
        self.told[slabs.OUTCOME], self.told[slabs.LENGTH] = outcome, length
        kind, message = self.client.outcome()
        return self.client.columns() if kind == slabs.COLUMNS else message.value  # type: ignore


@given(
    st.lists(
        st.lists(st.dictionaries(st.sampled_from("ab"), SCALARS) | INFOS, min_size=2, max_size=2),
        min_size=1,
        max_size=3,
    ).flatmap(lambda kinds: st.lists(st.sampled_from(kinds))),
    st.booleans(),
)
def test_infos_cross_a_slab_unchanged(steps: list[list[dict[str, Any]]], served: bool) -> None:
    """Whether they go encoded or as columns, the client has what Gymnasium would give."""
    slab = Slab(2, served=served)
    for infos in filter(any, steps):
        joined = None
        with suppress(Exception):  # Gymnasium cannot join them
            joined = Oracle().join(infos)
        if joined is not None:
            expected = m.unpack(m.pack(m.Value(joined)))
            assert_same(expected.value, slab.cross(infos))  # type: ignore[attr-defined]


@pytest.mark.parametrize("served", [False, True])
def test_infos_of_ends_have_forms_beside_the_columns(served: bool) -> None:
    """A server brings no forms: there the steps after them start columns anew."""
    slab = Slab(3, served=served)
    finals = [np.arange(2.0), np.float32([1]), {"a": np.int8([3]), "text": "b"}, 7, np.int16(8)]
    for final in finals:
        for step in range(40):
            infos: list[Any] = [{"x": step + index / 2} for index in range(3)]
            if step % 2:
                infos[step % 3] = {"final_obs": final, "final_info": {"r": step / 4}}
            assert_same(Oracle().join(infos), slab.cross(infos))
        last = (slabs.DONE, slabs.DONE) if served else (slabs.COLUMNS, slabs.FORMED)
        assert slab.outcomes[-6:] == [*last] * 3


_MANY = dict.fromkeys(map(str, range(1024)), 1)


@pytest.mark.parametrize("value", [{}, {1: "a"}, 0.5, np.array(1), np.array([b"a"]), _MANY])
def test_other_members_of_an_array_of_objects_have_no_form(value: Any) -> None:
    objects = np.array([None, None])
    with pytest.raises(IrregularError):
        StepColumns([objects], 4096)
    objects[1] = value
    with pytest.raises(IrregularError):
        StepColumns([objects], 4096).write([objects], bytearray(4096), 0)


@pytest.mark.parametrize(("member", "shape"), [(None, ()), ((None, "a"), ()), ("a", (2, 2))])
def test_arrays_of_objects_of_another_shape_have_no_form(member: Any, shape: Any) -> None:
    columns, others = StepColumns([np.array([None, "a"])], 4096), np.empty(shape, object)
    others.fill(member)
    with pytest.raises(IrregularError):
        columns.write([others], bytearray(4096), 0)


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
