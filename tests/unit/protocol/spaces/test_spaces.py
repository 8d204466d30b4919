"""Spaces cross with every attribute; lies about them build nothing."""

import copy
import tracemalloc
import warnings
from collections.abc import Iterable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import batch_space
from hypothesis import given
from hypothesis import strategies as st

from envhub_sandbox.errors import WorkerTimeoutError
from envhub_worker.protocol.codec.encoder import encode
from envhub_worker.protocol.errors import LocalProtocolError, RemoteProtocolError
from envhub_worker.protocol.spaces.reader import ELEMENT_BYTES, SPACE_BYTES, SpaceReader
from envhub_worker.protocol.spaces.spaces import (
    MAX_SPACE_DEPTH,
    OpaqueSpace,
    encode_space,
    seeded_nodes,
    seeded_states,
)
from tests.support.compare import assert_same
from tests.support.decode import decode
from tests.support.wire import decode_space, not_refused

Space = gym.Space[Any]
INF = float("inf")
MANY = 10**6
OneOf: Any = getattr(spaces, "OneOf", None)


class CustomSpace(gym.Space[Any]):
    """A space that the receiver does not have."""

    def __init__(self) -> None:
        super().__init__((3,), np.float32)


class BoxOfMine(spaces.Box):
    """A subclass that the receiver does not have."""


def through(space: Space) -> Space:
    return decode_space(decode(encode(encode_space(space))), max_elements=MANY)


def parts(space: Any) -> list[Space]:
    if isinstance(space, spaces.Dict):
        return list(space.spaces.values())
    if isinstance(space, spaces.Sequence):
        return [space.feature_space]
    if isinstance(space, spaces.Graph):
        return [part for part in (space.node_space, space.edge_space) if part is not None]
    return list(getattr(space, "spaces", ()))


ATTRIBUTES = (
    "low", "high", "n", "start", "nvec", "min_length", "max_length", "character_list",
    "character_set", "sort_keys", "stack", "shape", "dtype", "type_name", "text", "dtype_text",
)  # fmt: skip


def assert_same_attributes(expected: Any, actual: Any) -> None:
    """Asserts what ``==`` does not look at: types, exact bounds, order of keys and characters."""
    assert type(actual) is type(expected)
    for name in ATTRIBUTES:
        if hasattr(expected, name):
            assert_same(getattr(expected, name), getattr(actual, name), name)
    if isinstance(expected, spaces.Box):
        # Of a 0-d Box they are arrays or numpy booleans, depending on how it was made.
        assert np.array_equal(expected.bounded_below, actual.bounded_below)
        assert np.array_equal(expected.bounded_above, actual.bounded_above)
    if isinstance(expected, spaces.Dict):
        assert list(expected.spaces) == list(actual.spaces)
    assert len(parts(expected)) == len(parts(actual))
    for left, right in zip(parts(expected), parts(actual), strict=True):
        assert_same_attributes(left, right)


def samples(space: Space) -> object:
    space.seed(123)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numpy's, about casts that Box.sample makes
        try:
            return [space.sample() for _ in range(3)]
        except (OverflowError, ValueError) as error:
            return type(error).__name__


def assert_crosses(space: Space) -> None:
    arrived = through(space)
    assert arrived == space
    assert repr(arrived) == repr(space)
    assert_same_attributes(space, arrived)
    assert_same(samples(space), samples(arrived), "samples")


# --- every kind ---------------------------------------------------------------------------------

BOXES = [
    spaces.Box(-1, 1, (3,)),
    spaces.Box(-INF, INF, (2, 2)),
    spaces.Box(0, 255, (84, 84, 4), np.uint8),
    spaces.Box(np.array([-1, 0, -INF]), np.array([1, INF, 3]), dtype=np.float64),
    spaces.Box(0, 1, (), np.float32),
    spaces.Box(-INF, 5, (3,), np.int32),
    spaces.Box(-5, INF, (3,), np.int64),
    spaces.Box(np.array([-INF, 0, 2]), np.array([INF, 3, INF]), dtype=np.int16),
    spaces.Box(0, 1, (0, 3)),
    spaces.Box(-1, 1, (2,), np.float16),
    spaces.Box(-0.0, 0.0, (2,)),
    spaces.Box(np.finfo("f8").min, np.finfo("f8").max, (2,), np.float64),
]
OTHERS = [
    spaces.Discrete(5),
    spaces.Discrete(np.int64(3), start=-2),
    spaces.Discrete(2**62),
    spaces.MultiDiscrete([[2, 3], [4, 5]]),
    spaces.MultiDiscrete([3, 4], start=[1, 2]),
    spaces.MultiDiscrete([[[3]]], dtype=np.int32),
    spaces.MultiBinary(4),
    spaces.MultiBinary([2, 3]),
    spaces.MultiBinary((2,)),
    spaces.Text(5),
    spaces.Text(7, min_length=0, charset="zabé\U0001f600 "),
    spaces.Text(3, charset=frozenset("qwerty")),
]
NESTED = [
    spaces.Dict({"b": spaces.Discrete(2), "a": spaces.Box(0, 1, (2,))}),
    spaces.Dict([("z", spaces.Discrete(2)), ("a", spaces.Discrete(3)), ("m", spaces.Text(2))]),
    spaces.Dict([(1, spaces.Discrete(2)), ("a", spaces.Discrete(3))]),
    spaces.Dict({}),
    spaces.Tuple([]),
    spaces.Tuple([spaces.Discrete(2), spaces.Tuple([spaces.Text(2)])]),
    spaces.Sequence(spaces.Box(0, 1, (2,))),
    spaces.Sequence(spaces.Dict({"x": spaces.Discrete(3)}), stack=True),
    spaces.Graph(spaces.Box(0, 1, (2,)), spaces.Discrete(3)),
    spaces.Graph(spaces.Discrete(3), None),
]
ALL = [*BOXES, *OTHERS, *NESTED, *([OneOf([BOXES[0], OTHERS[0]])] if OneOf else [])]


@pytest.mark.parametrize("batched", [False, True])
def test_spaces_arrive_with_every_attribute(batched: bool) -> None:
    for space in ALL:
        assert_crosses(batch_space(space, 3) if batched else space)


def test_one_of_is_opaque_where_gymnasium_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("envhub_worker.protocol.spaces.reader.OneOf", None)
    value = {"kind": "one_of", "spaces": [encode_space(spaces.Discrete(2))]}
    space = decode_space(value, max_elements=MANY)
    assert repr(space) == "OpaqueSpace(gymnasium.spaces.OneOf: OneOf([Discrete(2)]))"


def test_dtype_of_discrete_arrives_where_gymnasium_has_one() -> None:
    """Discrete spaces have dtypes since Gymnasium 1.2; without, they are int64 on both sides."""
    value = {"kind": "discrete", "n": 200, "start": 5, "dtype": "uint8"}
    space = decode_space(value, max_elements=MANY)
    assert space == through(space)
    assert isinstance(space.sample(), np.integer)


def test_unsorted_plain_dict_keeps_its_order_and_flag() -> None:
    space = spaces.Dict([("b", spaces.Discrete(2)), ("a", spaces.Discrete(2))])
    space.sort_keys = False
    value = encode_space(space)
    assert value["keys"] == ["b", "a"]
    assert value["sort_keys"] is False


def test_random_state_does_not_travel() -> None:
    space = spaces.Discrete(2**40)
    space.seed(1)
    assert encode(encode_space(space)) == encode(encode_space(spaces.Discrete(2**40)))


def test_decoded_bounds_can_be_written() -> None:
    """Uniform bounds are expanded to arrays of their own, as Gymnasium makes them."""
    for space in (spaces.Box(0, 1, (2, 2)), batch_space(spaces.MultiDiscrete([2, 3]), 2)):
        arrived: Any = copy.deepcopy(through(space))
        for name in ("low", "high", "bounded_below", "bounded_above", "nvec", "start"):
            if hasattr(arrived, name):
                getattr(arrived, name)[0, 0] = 1
                assert getattr(arrived, name)[1, 1] == getattr(space, name)[1, 1]


def test_uniform_bounds_are_compact() -> None:
    """A camera's bounds take a few bytes, and a batch's no more than a single one's."""
    single = spaces.Box(np.linspace(-1, 0, 50), np.linspace(1, 2, 50))
    camera = encode(encode_space(spaces.Box(0, 255, (4, 480, 640, 3), np.uint8)))
    assert sum(map(len, camera)) < 400
    one = sum(map(len, encode(encode_space(single))))
    assert sum(map(len, encode(encode_space(batch_space(single, 1000))))) < one + 20


@st.composite
def boxes(draw: st.DrawFn) -> Space:
    dtype = np.dtype(draw(st.sampled_from(["i1", "i2", "i4", "i8", "u1", "u4", "f2", "f4", "f8"])))
    shape = tuple(draw(st.lists(st.integers(0, 3), max_size=3)))
    number = st.integers(0, 50)
    # Gymnasium before 1.4 turns infinite int64 bounds around.
    infinite = st.nothing() if dtype.kind == "u" or dtype == np.int64 else st.just(INF)
    bound = number | infinite
    size = int(np.prod(shape))
    uniform = bound.map(lambda value: [value] * size)
    high = np.array(draw(uniform | st.lists(bound, min_size=size, max_size=size)), float)
    low = np.array(draw(uniform | st.lists(bound, min_size=size, max_size=size)), float)
    low = np.minimum(low, high) if dtype.kind == "u" else -low
    low[~np.isfinite(low) & (low > 0)] = 0
    return spaces.Box(low.reshape(shape), high.reshape(shape), dtype=dtype.type)


def collections_of(children: st.SearchStrategy[Space]) -> st.SearchStrategy[Space]:
    some = st.lists(children, max_size=3)
    kinds = [
        some.map(spaces.Tuple),
        st.dictionaries(st.text("abcé", max_size=2), children, max_size=3).map(
            lambda named: spaces.Dict(list(named.items()))
        ),
        children.map(spaces.Sequence),
    ]
    if OneOf is not None:
        kinds.append(st.lists(children, min_size=1, max_size=3).map(OneOf))
    return st.one_of(kinds)


leaves = (
    boxes()
    | st.builds(spaces.Discrete, st.integers(1, 2**40), start=st.integers(-(2**40), 2**40))
    | st.lists(st.integers(1, 9), min_size=1, max_size=4).map(spaces.MultiDiscrete)
    | st.lists(st.integers(1, 3), min_size=1, max_size=3).map(spaces.MultiBinary)
    | st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1, max_size=8).map(
        lambda text: spaces.Text(5, min_length=1, charset="".join(dict.fromkeys(text)))
    )
    | st.builds(spaces.Graph, boxes(), st.none() | st.integers(1, 5).map(spaces.Discrete))
)


@given(st.recursive(leaves, collections_of, max_leaves=6))
def test_nested_spaces_arrive(space: Space) -> None:
    assert_crosses(space)


# --- custom spaces ------------------------------------------------------------------------------


def test_subclass_arrives_as_its_gymnasium_base() -> None:
    arrived = through(BoxOfMine(0, 1, (2,)))
    assert type(arrived) is spaces.Box
    assert arrived == spaces.Box(0, 1, (2,))


def test_custom_space_describes_itself() -> None:
    space = through(CustomSpace())
    assert isinstance(space, OpaqueSpace)
    assert space.type_name == f"{__name__}.CustomSpace"
    assert space.text.endswith("CustomSpace object>")
    assert (space.shape, space.dtype_text) == ((3,), "float32")
    assert space.type_name in repr(space)
    assert_same_attributes(space, through(space))


def test_custom_space_refuses_to_sample_and_to_judge() -> None:
    space = through(CustomSpace())
    with pytest.raises(gym.error.CustomSpaceError, match=r"CustomSpace.*inside the sandbox"):
        space.sample()
    with pytest.raises(gym.error.CustomSpaceError, match="membership"):
        space.contains(np.zeros(3))
    with pytest.raises(gym.error.CustomSpaceError, match="membership"):
        _ = 3 in space


def test_custom_spaces_compare_copy_and_batch() -> None:
    one, other = through(CustomSpace()), through(CustomSpace())
    assert one == other == copy.deepcopy(one)
    assert len({one, other}) == 1
    assert one != OpaqueSpace("a.B", "b")
    assert through(batch_space(CustomSpace(), 2)) == batch_space(one, 2)
    assert not one.is_np_flattenable


@pytest.mark.parametrize(
    "space", [spaces.Box(0, 1, (1,), np.longdouble), spaces.Text(3, charset="a\udc80")]
)
def test_space_that_the_wire_cannot_carry_is_described(space: Space) -> None:
    assert isinstance(through(space), OpaqueSpace)


# --- lies ---------------------------------------------------------------------------------------


def nested(levels: int) -> Space:
    space: Space = spaces.Discrete(2)
    for _ in range(levels):
        space = spaces.Tuple([space])
    return space


def test_depth_is_bounded_on_both_sides() -> None:
    assert_crosses(nested(MAX_SPACE_DEPTH))
    with pytest.raises(LocalProtocolError, match="deeper"):
        encode_space(nested(MAX_SPACE_DEPTH + 1))
    value = {"kind": "tuple", "spaces": [encode_space(nested(MAX_SPACE_DEPTH))]}
    with pytest.raises(RemoteProtocolError, match="deeper"):
        decode_space(value, max_elements=MANY)


@pytest.mark.parametrize(
    ("space", "spaces_in_it", "more"),
    [
        (spaces.Box(0, 1, (3, 4)), 1, 12 * 10),
        (spaces.Box(0, 1, (), np.float64), 1, 18),
        (spaces.Discrete(10**9), 1, 0),
        (spaces.MultiDiscrete([5, 5]), 1, 2 * 32),
        (spaces.MultiBinary([2, 3]), 1, 6 * 10),
        (spaces.Text(4, charset="abc"), 1, 3 * 256 + 4 * 10),
        (spaces.Tuple([spaces.Box(0, 1, (3,)), spaces.Discrete(2)]), 3, 3 * 10),
        (spaces.Dict({"a": spaces.Box(0, 1, (3,))}), 2, 3 * 10),
        (spaces.Sequence(spaces.Box(0, 1, (3,))), 3, 6 * 10),
        (spaces.Graph(spaces.Box(0, 1, (3,)), spaces.Discrete(2)), 5, 6 * 10),
        (spaces.Tuple([spaces.Box(0, 1, (3,))] * 4), 5, 3 * 10),
    ],
    ids=repr,
)
def test_bytes_of_all_spaces_are_counted(space: Space, spaces_in_it: int, more: int) -> None:
    """``max_elements`` is exact: all that is built counts, and what is alike counts once."""
    elements = -(-(spaces_in_it * SPACE_BYTES + more) // ELEMENT_BYTES)
    assert decode_space(encode_space(space), max_elements=elements) == space
    with pytest.raises(RemoteProtocolError, match="elements"):
        decode_space(encode_space(space), max_elements=elements - 1)


@pytest.mark.parametrize(
    "value",
    [
        {"kind": "box", "shape": (200_000_000,)},
        {"kind": "box", "shape": (2**31 - 1, 2**31 - 1)},
        {"kind": "box", "shape": (0, 2**31 - 1)},
        {"kind": "multi_discrete", "shape": (200_000_000,)},
        {"kind": "multi_binary", "n": 2**60},
        {"kind": "multi_binary", "n": (2**30, 2**30)},
        {"kind": "text", "max_length": 2**60},
        {"kind": "tuple", "spaces": [{"kind": "multi_binary", "n": 600_000}] * 2},
    ],
    ids=repr,
)
def test_absurd_sizes_are_refused_before_they_are_allocated(value: dict[str, Any]) -> None:
    honest = {
        "box": encode_space(spaces.Box(0, 1, (1,))),
        "multi_discrete": encode_space(spaces.MultiDiscrete([2, 2])),
        "text": encode_space(spaces.Text(3)),
    }
    value = honest.get(value["kind"], {}) | value
    tracemalloc.start()
    with pytest.raises(RemoteProtocolError, match="elements"):
        decode_space(value, max_elements=MANY)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2 * MANY


def test_boxes_that_are_alike_share_their_bounds_and_nothing_else() -> None:
    """A suite's hundred tasks cost what one does; each draws numbers of its own."""
    value = encode_space(spaces.Box(0, 255, (100, 100), np.uint8))
    reader = SpaceReader(10_000 + 2 * SPACE_BYTES)
    boxes = [reader.space(decode(encode(value))) for _ in range(20)]
    assert all(box == boxes[0] for box in boxes)
    assert all(np.shares_memory(box.low, boxes[0].low) for box in boxes)
    boxes[0].seed(0)
    boxes[1].seed(1)
    assert boxes[0].np_random is not boxes[1].np_random
    assert (boxes[0].sample() != boxes[1].sample()).any()
    with pytest.raises(RemoteProtocolError, match="elements"):
        reader.space(encode_space(spaces.Box(0, 254, (100, 100), np.uint8)))


def test_what_is_in_a_sequence_has_bounds_of_its_own() -> None:
    box = spaces.Box(0, 1, (1000,))
    value = encode_space(spaces.Tuple([box, *[spaces.Sequence(box)] * 3]))
    with pytest.raises(RemoteProtocolError, match="elements"):
        decode_space(value, max_elements=1000 * (1 + 2 * 2 + 1))


def test_reading_asks_before_each_space() -> None:
    asked = []

    def check() -> None:
        asked.append(1)
        if len(asked) == 3:
            raise WorkerTimeoutError("late")

    value = encode_space(spaces.Tuple([spaces.Discrete(2)] * 5))
    with pytest.raises(WorkerTimeoutError):
        SpaceReader(MANY, check).space(value)
    assert len(asked) == 3


BOX = encode_space(spaces.Box(0, 1, (2,)))
DISCRETE = encode_space(spaces.Discrete(3))
MULTI = encode_space(spaces.MultiDiscrete([2, 3]))
TEXT = encode_space(spaces.Text(3, charset="ab"))
DICT = encode_space(spaces.Dict({"a": spaces.Discrete(2), "b": spaces.Discrete(2)}))
OPAQUE = encode_space(CustomSpace())
ONE = np.array(1, "f4")


def without(value: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: item for key, item in value.items() if key != name}


def lies(honest: dict[str, Any], **fields: Iterable[object]) -> list[dict[str, Any]]:
    return [honest | {name: lie} for name, values in fields.items() for lie in values]


MALFORMED = [
    *(None, [], {}, {"kind": 1}, {"kind": []}, {"kind": "Box"}, {"kind": "os.system"}),
    *(without(BOX, "low"), BOX | {"seed": 1}),
    *lies(BOX, dtype=("object", "V2000000000", "float128", None, "int64")),
    *lies(BOX, shape=([2], (-1,), (2.0,), (True,), (np.int64(2),), (2**31,), (1,) * 33, None)),
    *lies(BOX, low=(0.0, None, np.float32(0), np.array(0.0), np.array([0, 0, 0], "f4"))),
    *lies(BOX, low=(np.array([[0, 0]], "f4"), np.array(["x"], object), np.array(2, "f4"))),
    BOX | dict.fromkeys(("low", "high"), np.array(np.nan, "f4")),
    *lies(BOX, bounded_below=(ONE, True), bounded_above=[np.array([True, True, False])]),
    *lies(DISCRETE, n=(0, -1, 2.0, True, 2**63, 2**200), dtype=("float32", "bool")),
    *lies(DISCRETE, start=(None, 2**63 - 2, -(2**63) - 1)),
    DISCRETE | {"dtype": "int8", "n": 200},
    *lies(MULTI, nvec=map(np.array, ([2, 0], [2, -3], [2.0, 3.0], [2, 3, 4]))),
    *lies(MULTI, start=[np.array([0, 0, 0])], dtype=["float64"]),
    *lies({"kind": "multi_binary"}, n=(0, -1, 2.5, (0,), (2, "x"), np.array([2]))),
    *lies(TEXT, characters=("aa", ["ab"], "a\ud800")),
    *lies(TEXT, min_length=(-1, 4), max_length=(3.0, None)),
    *lies(DICT, keys=(["a"], ["a", "a"], ["a", []], ("a", "b"), [1, True]), sort_keys=[1]),
    DICT | {"spaces": {"a": DISCRETE, "b": DISCRETE}},
    *lies({"kind": "tuple"}, spaces=(None, [None], [spaces.Discrete(2)])),
    {"kind": "one_of", "spaces": [{"kind": "one_of", "spaces": 3}]},
    {"kind": "sequence", "space": None, "stack": False},
    {"kind": "sequence", "space": DISCRETE, "stack": 1},
    *lies({"kind": "graph", "node": None}, edge=[None]),
    *lies({"kind": "graph", "node": DISCRETE}, edge=[5]),
    *lies(OPAQUE, type=[1], text=[None], dtype=[np.float32], shape=[(2**40,)]),
]


def test_malformed_descriptions_are_refused() -> None:
    assert not_refused(lambda value: decode_space(value, max_elements=MANY), MALFORMED) == []


def test_description_of_a_custom_space_is_cleaned() -> None:
    space = decode_space(
        OPAQUE | {"type": "\x1b[31m" * 100, "text": "\u202e" * 9999, "dtype": "\n"},
        max_elements=MANY,
    )
    assert repr(space).isprintable()
    assert len(repr(space)) < 2000


# --- generators ---------------------------------------------------------------------------------


def seedable() -> spaces.Dict:
    pair = spaces.Tuple([spaces.Discrete(2), spaces.Box(0, 1, (2,), np.float32)])
    return spaces.Dict({"a": spaces.MultiBinary(3), "b": pair})


def test_nodes_come_in_a_fixed_order() -> None:
    kinds = [type(node).__name__ for node in seeded_nodes(seedable())]
    assert kinds == ["Dict", "MultiBinary", "Tuple", "Discrete", "Box"]


def test_what_nobody_seeded_does_not_travel() -> None:
    """Even where it has drawn; a remembered description would make each run the same."""
    space = seedable()
    space.sample()
    assert seeded_states(space) is None


def test_the_same_seed_is_the_same_states() -> None:
    seeded = [seedable() for _ in range(3)]
    for space, seed in zip(seeded, (1, 1, 2), strict=True):
        space.seed(seed)
    first, same, other = (repr(seeded_states(space)) for space in seeded)
    assert first == same != other
    seeded[0].sample()
    assert repr(seeded_states(seeded[0])) != same


def test_a_shared_generator_is_told_once() -> None:
    one = spaces.Discrete(2, seed=3)
    states = seeded_states(spaces.Tuple([one, copy.copy(one)]))
    assert states[2] == 1
    assert not isinstance(states[1], int)
