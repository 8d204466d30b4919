"""Infos that come from several shards are what one vector environment would have made of them."""

import itertools
import warnings
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from hypothesis import given
from hypothesis import strategies as st

from envhub_sandbox.transport.results import Results
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.shared_memory.columns import StepColumns
from envhub_worker.protocol.spaces import batches
from tests.support import inside, wire
from tests.support.compare import assert_same

VALUES: dict[str, st.SearchStrategy[Any]] = {
    "int": st.integers(-9, 9),
    "float": st.floats(allow_nan=True, width=32),
    "bool": st.booleans(),
    "text": st.text(max_size=3),
    "none": st.none(),
    "list": st.lists(st.integers(), max_size=2),
    "array": st.integers(0, 9).map(lambda n: np.full((2, 2), n, np.int16)),
    "words": st.sampled_from(["abc", "cde"]).map(lambda word: np.array([word])),
    "objects": st.integers(0, 9).map(lambda n: np.array([n, None], dtype=object)),
    "final_obs": st.integers(0, 9).map(lambda n: np.array([n])),
    "mixed": st.one_of(st.text(max_size=2), st.none(), st.lists(st.text(), max_size=1)),
}
FLAT = st.fixed_dictionaries({}, optional=VALUES)
INFO = st.fixed_dictionaries({}, optional={**VALUES, "nested": FLAT, "deep": st.just({"a": {}})})


def added(infos: list[dict[str, Any]]) -> dict[str, Any]:
    env: VectorEnv[Any, Any, Any] = VectorEnv()
    env.num_envs = len(infos)
    joined: dict[str, Any] = {}
    for index, info in enumerate(infos):
        joined = env._add_info(joined, info, index)
    return joined


def sent(infos: list[dict[str, Any]]) -> dict[Any, Any]:
    """What a shard sends, as it arrives."""
    pairs = [(index, info) for index, info in enumerate(infos) if info]
    forms = [batches.forms_of(info) for _, info in pairs]
    columns = batches.flat_infos(pairs, len(infos))
    own = batches.own_infos(pairs, len(infos), forms) if columns is None else columns
    arrived = m.unpack(m.pack(m.Value(own)))
    assert isinstance(arrived, m.Value)
    return arrived.value  # type: ignore[return-value]


NUMBERS = st.sampled_from([1, 2, 0.5, True, 2**60 + 1, np.int64(300), np.int8(3), np.float32(0.1)])
ARRAYS = st.sampled_from([np.ones(2), np.ones(2, np.int8), np.ones((2, 1)), np.ones((0, 2))])
ALIKE = st.fixed_dictionaries({"array": ARRAYS, "inner": st.fixed_dictionaries({"n": NUMBERS})})
NUMBER = st.fixed_dictionaries({"number": NUMBERS})
OBJECTS = ["text", None, Decimal("2.5"), Decimal(0), Fraction(7, 2)]
ANY = st.sampled_from([1, 0.5, True, np.float64(0.1), np.array(None), np.ones(2), {}, *OBJECTS])
UNLIKE = st.tuples(INFO, st.fixed_dictionaries({}, optional={"number": NUMBERS, "any": ANY}))


@given(
    st.lists(NUMBER | UNLIKE.map(lambda two: two[0] | two[1]), min_size=2, max_size=6)
    | st.lists(NUMBER, min_size=2, max_size=6)
    | st.lists(ALIKE, min_size=2, max_size=6),
    st.data(),
)
def test_shards_join_as_one_batch(infos: list[dict[str, Any]], data: st.DataObject) -> None:
    """However the sub-environments are cut into shards, the joined infos are Gymnasium's."""
    cuts = data.draw(st.sets(st.integers(1, len(infos) - 1), min_size=1))
    bounds = [*itertools.pairwise([0, *sorted(cuts), len(infos)])]
    space = spaces.Discrete(2)
    results = Results(wire.env_manifest(space, space, len(infos)), bounds)
    parts = [sent(infos[start:stop]) for start, stop in bounds]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            expected = added(infos)
        except Exception as error:
            with pytest.raises(type(error)):
                results.infos(parts)
            return
        assert_same(expected, results.infos(parts))


def test_values_that_the_wire_changes_are_joined_alike() -> None:
    """A column of numbers makes numbers of other objects; structures are tuples in every row."""
    structure = np.dtype([("a", np.int64), ("b", np.float32)])
    one: list[Any] = [{"d": 1}, {"d": Decimal("2.5")}, {"d": True}]
    one[1] |= {"x": np.array((1, 2.5), structure), "y": np.array([(3, 4)], structure)}
    space = spaces.Discrete(2)
    results = Results(wire.env_manifest(space, space, 3), [(0, 1), (1, 3)])
    infos = results.infos([sent(one[:1]), sent(one[1:])])
    expected = m.unpack(m.pack(m.Value(added(one))))
    assert_same(expected.value, infos)  # type: ignore[attr-defined]


def test_columns_of_a_slice_are_recurring_forms() -> None:
    """In a message that comes again, and in memory, they are read without the codec."""
    row = {"a": 0.5, "inner": {"b": np.int8(3)}, "array": np.ones(2)}
    columns = batches.flat_infos([(0, row), (1, row)], 2)
    message = m.Value(columns)
    frames = m.pack(message)
    for _ in range(3):
        assert_same(columns, m.unpack(frames).value)  # type: ignore[attr-defined]
    assert any(bytes(frames[0]).startswith(document) for document in inside.forms())
    memory, form = bytearray(4096), StepColumns([columns], 4096)
    written = form.write([columns], memory, 0)
    [read] = form.read(memory, 0, written, tensors=lambda array, name: array)
    assert_same(columns, read)
