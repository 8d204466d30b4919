"""Values that a caller may hand to an environment: one of every kind that Python and numpy have."""

import collections
import dataclasses
import datetime
import decimal
import enum
import fractions
import functools
import operator
import pathlib
import types
import typing
import uuid
from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium.spaces.graph import GraphInstance
from gymnasium.vector import AutoresetMode


class Level(enum.Enum):
    """An enumeration."""

    LOW = "low"
    HIGH = ("high", 2)
    MAPPED = {"high": [2]}  # noqa: RUF012


class Code(enum.IntEnum):
    """One of integers."""

    A = 7


class Word(str, enum.Enum):
    """One of texts, as ``StrEnum`` is."""

    RED = "red"


class Flags(enum.Flag):
    """One of bits."""

    X = 1
    Y = 2


class Pose(typing.NamedTuple):
    """A tuple with names."""

    x: float
    y: Any = None


@dataclasses.dataclass
class Camera:
    """A configuration of the caller's own."""

    pose: Pose
    sizes: dict[str, int] = dataclasses.field(default_factory=dict)


class OwnDict(dict):
    """A dict with a class."""


class OwnList(list):
    """A list with a class."""


class OwnInt(int):
    """An int with a class."""


class OwnText(str):
    """A str with a class."""

    __slots__ = ()


class OwnArray(np.ndarray):
    """An array with a class."""


def half(value: float) -> float:
    return value / 2


def _cyclic() -> list[Any]:
    value: list[Any] = [1, {"a": 2}]
    value[1]["self"] = value
    return value


def _nested(depth: int) -> list[Any]:
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


def _objects() -> Any:
    array = np.empty((2, 2), object)
    array[0] = [None, "x"]
    array[1, 0], array[1, 1] = [1, 2], Level.LOW
    return array


Point = collections.namedtuple("Point", "x y")
STRUCTURED = np.dtype([("a", "<i4"), ("b", "<f8", (2,))])
PLAIN: dict[str, Any] = {
    "None": None,
    "bool": True,
    "int": -5,
    "large int": -(2**200),
    "float": -0.0,
    "nan": float("nan"),
    "complex": 1 - 2j,
    "text": "héllo",
    "bytes": b"\0\xff",
    "list": [1, [2.0, None]],
    "tuple": (1, ("a",), ()),
    "dict": {"b": 1, "a": {2: (3,)}, (1, 2): 3, None: 4},
    "set": {1, "a", (2, 3)},
    "frozenset": frozenset({1, 2}),
    "range": range(5, -7, -2),
    "slice": slice(None, 3, None),
    "np.int8": np.int8(-3),
    "np.uint64": np.uint64(2**64 - 1),
    "np.float16": np.float16(0.1),
    "np.bool": np.bool_(True),
    "np.complex64": np.complex64(1j),
    "np.str": np.str_("é"),
    "np.bytes": np.bytes_(b"x"),
    "datetime64": np.datetime64("2024-05-06T07:08", "m"),
    "NaT": np.datetime64("NaT"),
    "timedelta64": np.timedelta64(7, "10ms"),
    "array": np.arange(6, dtype=np.float32).reshape(2, 3),
    "0-d": np.array(3, np.int16),
    "empty": np.empty((0, 3), np.uint8),
    "strided": np.arange(10)[::3],
    "backwards": np.arange(4)[::-1],
    "bool array": np.array([True, False]),
    "bytes array": np.array([b"ab", b"c"]),
    "datetime array": np.array(["2024-01-01", "NaT"], "M8[D]"),
    "object array": np.array([1, None, "x"], object),
    "0-d object": np.array({"a": 1}, object),
}
"""What the wire has a form for."""
PICKLED: dict[str, Any] = {
    "Enum": Level.HIGH,
    "IntEnum": Code.A,
    "StrEnum": Word.RED,
    "Flag": Flags.X | Flags.Y,
    "AutoresetMode": AutoresetMode.DISABLED,
    "namedtuple": Point(1, 2),
    "NamedTuple": Pose(1.5, [2]),
    "GraphInstance": GraphInstance(np.zeros((2, 1)), None, None),
    "OrderedDict": collections.OrderedDict(b=1, a=2),
    "defaultdict": collections.defaultdict(list, a=[1]),
    "Counter": collections.Counter("aab"),
    "deque": collections.deque([1, 2], maxlen=3),
    "ChainMap": collections.ChainMap({"a": 1}, {"b": 2}),
    "mappingproxy in a": types.SimpleNamespace(a=1, b=[2]),
    "bytearray": bytearray(b"\0\1"),
    "memoryview": memoryview(b"\0\1"),
    "memoryview of numbers": memoryview(np.arange(6, dtype=np.int32).reshape(2, 3)),
    "huge int": 2**20_000,
    "surrogate": "a\udc80",
    "many keys": dict.fromkeys(range(300)),
    "many elements": frozenset(range(300)),
    "long list": list(range(150_000)),
    "long text": "ab" * 3_000_000,
    "many bytes": b"ab" * 3_000_000,
    "deep": _nested(60),
    "Fraction": fractions.Fraction(1, 3),
    "Decimal": decimal.Decimal("1.10"),
    "datetime": datetime.datetime(2024, 5, 6, 7, 8, tzinfo=datetime.timezone.utc),
    "date": datetime.date(2024, 5, 6),
    "timedelta": datetime.timedelta(seconds=1.5),
    "Path": pathlib.Path("/a/b"),
    "PurePath": pathlib.PureWindowsPath("c:/a"),
    "UUID": uuid.UUID(int=5),
    "dataclass": Camera(Pose(1.0), {"a": 3}),
    "subclass of dict": OwnDict(a=[1]),
    "subclass of list": OwnList([1, 2]),
    "subclass of int": OwnInt(5),
    "subclass of str": OwnText("x"),
    "subclass of ndarray": np.arange(3).view(OwnArray),
    "deep inside": {"a": [(1, {"b": Level.LOW})]},
    "key": {Level.LOW: 1, Point(1, 2): 2},
    "keys of any class": {Level.MAPPED: 1, (Level.MAPPED, 2): 2, range(2): 3, 1.5: 4, 2j: {b"": 5}},
    "in an array": _objects(),
    "structured": np.array([(1, (2.0, 3.0)), (4, (5.0, 6.0))], STRUCTURED),
    "np.void": np.array([(1, (2.0, 3.0))], STRUCTURED)[0],
    "recarray": np.rec.array([(1, 2.0)], names="a,b"),
    "longdouble": np.longdouble(1) / 3,
    "clongdouble array": np.array([1 + 2j], np.clongdouble),
    "Fortran order": np.asfortranarray(np.arange(6).reshape(2, 3)),
    "Fortran objects": np.asfortranarray(_objects()),
    "big-endian": np.arange(3, dtype=">i4"),
    "text array": np.array(["a", "bcd"]),
    "no text array": np.array(["", ""]),
    "surrogate array": np.array(["\udc80"]),
    "masked array": np.ma.array([1, 2, 3], mask=[0, 1, 0]),
    "large structured": np.zeros(5000, STRUCTURED),
    "dtype": STRUCTURED,
    "Generator": np.random.default_rng(5),
    "RandomState": np.random.RandomState(5),
    "Ellipsis": ...,
    "exception": ValueError("a", 1),
    "partial": functools.partial(half, 3.0),
    "attrgetter": operator.attrgetter("a.b"),
}
"""What it has none for, or one that would change it."""
CALLABLE: dict[str, Callable[..., Any]] = {
    "function": half,
    "lambda": lambda value: value + 1,
    "builtin": abs,
    "class": fractions.Fraction,
    "own class": OwnInt,
}
"""The same for what is called: it gives the same for 3."""
CYCLIC = _cyclic()
"""A list that holds itself."""
