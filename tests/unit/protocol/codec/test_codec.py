"""Values there and back with their types; hostile bytes nowhere."""

import collections
import dataclasses
import enum
import pickle
import sys
import types
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given

from envhub_worker.protocol.codec.arrays import INLINE_BYTES
from envhub_worker.protocol.codec.encoder import encode
from envhub_worker.protocol.codec.inert import RemoteEnum, RemoteObject
from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.errors import LocalProtocolError, RemoteProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from tests.support.compare import assert_same
from tests.support.decode import decode
from tests.support.values import objects, values
from tests.support.wire import deep, ext, packed


class Colour(enum.Enum):
    """An enumeration that the receiver does not have."""

    RED = (1, "r")


MEMBERS: tuple[Any, ...] = (
    *(enum.IntEnum("Low", {"A": 1}), enum.IntFlag("Flag", {"A": 1})),
    *(enum.Enum("Huge", {"A": 1 << 80}, type=int), enum.Enum("Text", {"A": "a"}, type=str)),
    *(enum.Enum("Real", {"A": 1.5}, type=float), enum.Enum("Byte", {"A": b"a"}, type=bytes)),
    *(enum.Enum("Int8", {"A": np.int8(3)}, type=np.int8),),
    enum.Enum("NumpyText", {"A": np.str_("b")}, type=np.str_),
)
"""Enumerations whose members are numbers or texts, and equal them in one process."""


@dataclasses.dataclass
class Point:
    """A class that the receiver does not have."""

    x: int


class Unprintable:
    """A class whose description fails."""

    def __repr__(self) -> str:
        raise RuntimeError("no")


def through(value: object, **options: Any) -> Any:
    return decode([bytes(frame) for frame in encode(value)], **options)


# --- what arrives -------------------------------------------------------------------------------


@given(values)
def test_nested_values_arrive_with_their_types(value: object) -> None:
    assert_same(value, through(value))


CORNERS = [
    2**63, 2**64 - 1, 2**64, -(2**63), -(2**63) - 1, 2**4000, -0.0, float("inf"), float("nan"),
    complex("1-infj"), "", "\0", "\U0001f600", b"", [], (), {}, set(), frozenset(), ((),),
    {(): {None: ()}}, {1: "a", "1": "b"}, {b"k": 1}, slice(None), slice(1, (2,), "x"),
    range(0), range(5, -5, -2), np.float64(1.5), np.float16("nan"), np.bool_(False),
    np.str_("é"), np.str_(""), np.bytes_(b"ab"), np.datetime64("2020-01-01T00", "h"),
    np.timedelta64(5, "ms"), np.array(None), np.zeros((0, 3), dtype=object),
    {"r": [np.array([1]), {"s": (np.float32(1), None)}]},
    objects([1, 2], np.zeros(3), np.array(5), (1,)).reshape(2, 2), deep(32),
    [deep(31), ["x" * 100] * 400],
]  # fmt: skip


def test_corner_values_arrive_with_their_types() -> None:
    for value in CORNERS:
        assert_same(value, through(value), repr(value)[:60])


@pytest.mark.parametrize(
    ("value", "plain"),
    [
        (collections.namedtuple("Pair", "a b")(1, 2), (1, 2)),
        (collections.OrderedDict(b=1, a=2), {"b": 1, "a": 2}),
        (collections.defaultdict(list, a=[1]), {"a": [1]}),
        (collections.Counter("aab"), {"a": 2, "b": 1}),
        (type("S", (str,), {})("x"), "x"),
        (type("I", (int,), {})(2**70), 2**70),
        (type("F", (float,), {})(0.5), 0.5),
        (type("L", (list,), {})([1]), [1]),
        (type("B", (bytes,), {})(b"x"), b"x"),
        (type("C", (complex,), {})(1j), 1j),
        (type("T", (set,), {})([1]), {1}),
        (type("Z", (frozenset,), {})([1]), frozenset([1])),
        (bytearray(b"x"), b"x"),
        (memoryview(b"x"), b"x"),
        (types.MappingProxyType({"a": 1}), {"a": 1}),
        (collections.deque([1]), [1]),
        *((members.A, members.A.value) for members in MEMBERS),
        *(({members.A: [members.A]}, {members.A.value: [members.A.value]}) for members in MEMBERS),
    ],
    ids=lambda value: type(value).__name__,
)
def test_subclasses_arrive_as_what_they_extend(value: object, plain: object) -> None:
    """A class of the sender's is not known to the receiver; what it extends is."""
    assert_same(plain, through(value))


def test_array_subclasses_arrive_as_arrays(monkeypatch: pytest.MonkeyPatch) -> None:
    array = np.arange(3).view(type("Sub", (np.ndarray,), {}))
    assert_same(np.arange(3), through(array))
    assert isinstance(through(np.ma.masked_array([1, 2], [0, 1])), RemoteObject)
    monkeypatch.setitem(sys.modules, "numpy.ma", types.ModuleType("numpy.ma"))
    assert_same(np.arange(3), through(array))


def test_lone_surrogates_arrive_as_visible_escapes() -> None:
    """Text that UTF-8 cannot carry crosses with its surrogates spelled out, and arrays with it."""
    value = {"path\udcff": [np.zeros(2), "a\ud800b"]}
    assert_same({"path\\udcff": [np.zeros(2), "a\\ud800b"]}, through(value))


def test_large_arrays_are_frames_and_small_ones_are_not() -> None:
    big, small = np.zeros(INLINE_BYTES + 1, np.uint8), np.zeros(4)
    frames = encode({"a": small, "b": [big, small], "c": big[:-1]})
    assert [len(frame) for frame in frames[1:]] == [INLINE_BYTES + 1]


# --- inert stand-ins ----------------------------------------------------------------------------


def test_enum_member_arrives_as_inert_name_and_value() -> None:
    red = through(Colour.RED)
    assert isinstance(red, RemoteEnum)
    assert (red.type_name, red.text) == (f"{__name__}.Colour", "RED")
    assert red.value == (1, "r")
    assert through({Colour.RED: 1}) == {red: 1}


@pytest.mark.parametrize("value", [object(), Point(1), lambda: 0, sys, int, {}.keys()])
def test_unknown_objects_arrive_as_their_description(value: object) -> None:
    remote = through(value)
    assert isinstance(remote, RemoteObject)
    assert remote.type_name.endswith(type(value).__qualname__)


def test_keys_that_look_alike_are_numbered() -> None:
    """Objects with one ``repr`` are different keys in the worker; a number tells them apart."""
    objects = [Unprintable() for _ in range(100)]
    mapping = through(dict(zip(objects, range(100), strict=True)))
    assert list(mapping.values()) == list(range(100))
    first, second, *_ = mapping
    assert (second.type_name, second.text) == (first.type_name, f"{first.text} #2")
    assert len(through(set(objects))) == 100
    assert list(through({(objects[0], 1): "a", (objects[1], 1): "b"}).values()) == ["a", "b"]


def test_description_is_bounded_printable_and_without_addresses() -> None:
    """A description never drives a terminal, never floods a log, and is the same every time."""
    loud = type("Loud", (), {"__repr__": lambda self: "\x1b[2J\n\u202e" + "x" * 10_000})()
    remote = through([loud, object()])
    assert remote[0].text.startswith("\\x1b[2J\\n\\u202exx")
    assert len(remote[0].text) < 1100
    assert remote[0].text.isprintable()
    assert remote[1].text == "<object object>"
    assert through(Unprintable()).text == "<repr failed with RuntimeError>"


# --- pickles, tensors, arrays of other libraries ------------------------------------------------


def test_failures_of_pickler_and_unpickler_are_protocol_errors() -> None:
    with pytest.raises(LocalProtocolError, match=r"kwargs\[.f.\]\[1\] cannot be sent"):
        encode({"kwargs": {"f": [0, lambda: 0]}}, pickler=pickle.dumps)
    with pytest.raises(RemoteProtocolError, match="cannot be loaded"):
        decode(packed(ext(5, b"junk")), unpickler=pickle.loads)


class Foreign:
    """An array of another library, by its protocol."""

    def __array__(self, *args: Any, **kwargs: Any) -> np.ndarray[Any, Any]:
        return np.arange(3.0)

    def __dlpack__(self) -> None: ...


class Broken(Foreign):
    """An array of another library that cannot be read any more."""

    def __array__(self, *args: Any, **kwargs: Any) -> np.ndarray[Any, Any]:
        raise RuntimeError("Array has been deleted.")


def test_arrays_of_other_libraries_arrive_as_numpy_arrays() -> None:
    """What speaks __array__ and __dlpack__ (jax, cupy) is an array; its failure names the path."""
    assert_same({"x": np.arange(3.0)}, through({"x": Foreign()}))
    with pytest.raises(LocalProtocolError, match=r"obs\[.x.\] cannot be sent: Array has been"):
        encode({"obs": {"x": Broken()}})


# --- what cannot be sent ------------------------------------------------------------------------


def cyclic() -> dict[str, Any]:
    value: dict[str, Any] = {"info": {"a": [0, 1, 2]}}
    value["info"]["a"].append(value["info"])
    return value


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (cyclic(), r"info\[.a.\]\[3\] cannot be sent: it contains itself"),
        ({"info": deep(32)}, r"info\[0\].* cannot be sent: it is nested deeper than 32"),
        (deep(1000), "nested deeper than 32"),
        ({1: 2**10_000}, r"value\[1\] cannot be sent: an integer"),
        ({("k", 2**10_000): 1}, "cannot be sent: an integer"),
        (b"x" * DEFAULT_LIMITS.header_bytes, "header_bytes"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_cannot_be_sent_is_refused_with_its_path(value: object, text: str) -> None:
    with pytest.raises(LocalProtocolError, match=text):
        encode(value)


# --- transports ---------------------------------------------------------------------------------


@pytest.mark.parametrize("wrap", [bytes, memoryview, lambda frame: memoryview(bytearray(frame))])
def test_frames_may_be_any_buffer(wrap: Callable[[Buffer], Buffer]) -> None:
    value = [np.arange(10.0), np.arange(10_000.0), "x"]
    assert_same(value, decode([wrap(frame) for frame in encode(value)]))


def test_decoded_arrays_do_not_alias_the_transport() -> None:
    buffers = [bytearray(frame) for frame in encode([np.ones(10), np.ones(10_000)])]
    small, large = decode([memoryview(buffer) for buffer in buffers])
    for buffer in buffers:
        buffer[:] = bytes(len(buffer))
    for array in (small, large):
        assert array.all()
        assert array.flags.writeable
