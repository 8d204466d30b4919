"""Gymnasium spaces as plain values, and back with every claim checked.

Works with Gymnasium 0.29 to 1.4, which may differ between the two ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import singledispatch
from inspect import signature
from typing import Any, NoReturn, TypeGuard

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from envhub_worker.protocol.arrays import MAX_DIMENSIONS
from envhub_worker.protocol.errors import LocalProtocolError, RemoteProtocolError
from envhub_worker.protocol.inert import MAX_NAME_CHARS, describe, one_line

# A nested space takes two containers of the wire's depth of 32; messages need some around it.
MAX_SPACE_DEPTH = 12
# Children of one Dict, Tuple or OneOf; a batch of custom spaces is a Tuple of as many.
MAX_CHILDREN = 65_536
# Keys of one Dict. Keys that are no text can be made to collide.
MAX_KEYS = 4096
MAX_INT64 = 2**63 - 1

_DTYPE_CODES = ("?", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8")
_BOX_DTYPES = {np.dtype(code).name: np.dtype(code) for code in _DTYPE_CODES}
_INTEGER_DTYPES = {name: dtype for name, dtype in _BOX_DTYPES.items() if dtype.kind in "iu"}
_DISCRETE_HAS_DTYPE = "dtype" in signature(spaces.Discrete.__init__).parameters

Space = gym.Space[Any]


class OpaqueSpace(gym.Space[Any]):
    """Stands for a space of the peer that Gymnasium does not know.

    It can say what it is, be compared and batched, and nothing else.

    Attributes:
        type_name: Qualified class name of the peer's space.
        text: Its ``repr``; bounded and printable.
        dtype_text: Its dtype as text, empty if it has none.
    """

    def __init__(
        self, type_name: str, text: str, shape: tuple[int, ...] | None = None, dtype_text: str = ""
    ) -> None:
        super().__init__(shape=shape)
        self.type_name, self.text, self.dtype_text = type_name, text, dtype_text

    @property
    def is_np_flattenable(self) -> bool:
        """False: nothing is known about its elements."""
        return False

    def sample(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Raises ``gymnasium.error.CustomSpaceError``."""
        self._refuse("sample from")

    def contains(self, x: object) -> NoReturn:
        """Raises ``gymnasium.error.CustomSpaceError``."""
        self._refuse("check membership of")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, OpaqueSpace) and self._identity() == other._identity()

    def __hash__(self) -> int:
        return hash(self._identity())

    def __repr__(self) -> str:
        return f"OpaqueSpace({self.type_name}: {self.text})"

    def _identity(self) -> tuple[object, ...]:
        return self.type_name, self.text, self.shape, self.dtype_text

    def _refuse(self, what: str) -> NoReturn:
        raise gym.error.CustomSpaceError(
            f"Cannot {what} {self.type_name}: its code exists only inside the sandbox. "
            "Build values for it yourself, or call the environment's own method for it."
        )


# --- encoding -----------------------------------------------------------------------------------


def encode_space(space: Space) -> dict[str, object]:
    """Describes a space by plain values and arrays.

    A subclass is described as its nearest Gymnasium base, any other custom space by its type
    and ``repr``. The state of a space's random generator does not travel.

    Raises:
        LocalProtocolError: Spaces nested deeper than 12.
    """
    return _encode(space, 0)


@singledispatch
def _encode(space: Any, depth: int) -> dict[str, object]:
    about = describe(space)
    shape = getattr(space, "shape", None)
    dtype = getattr(space, "dtype", None)
    return {
        "kind": "opaque",
        "type": about.type_name,
        "text": about.text,
        "shape": shape if _is_shape(shape) else None,
        "dtype": "" if dtype is None else one_line(str(dtype), MAX_NAME_CHARS),
    }


@_encode.register
def _(space: OpaqueSpace, depth: int) -> dict[str, object]:
    return {
        "kind": "opaque",
        "type": space.type_name,
        "text": space.text,
        "shape": space.shape,
        "dtype": space.dtype_text,
    }


@_encode.register
def _(space: spaces.Box, depth: int) -> dict[str, object]:
    if space.dtype.name not in _BOX_DTYPES:
        return _encode.dispatch(object)(space, depth)
    return {
        "kind": "box",
        "dtype": space.dtype.name,
        "shape": space.shape,
        "low": _compact(space.low),
        "high": _compact(space.high),
        "bounded_below": _compact(space.bounded_below),
        "bounded_above": _compact(space.bounded_above),
    }


@_encode.register
def _(space: spaces.Discrete, depth: int) -> dict[str, object]:
    return {
        "kind": "discrete",
        "n": int(space.n),
        "start": int(space.start),
        "dtype": np.dtype(space.dtype).name,
    }


@_encode.register
def _(space: spaces.MultiDiscrete, depth: int) -> dict[str, object]:
    return {
        "kind": "multi_discrete",
        "dtype": np.dtype(space.dtype).name,
        "shape": space.nvec.shape,
        "nvec": _compact(space.nvec),
        "start": _compact(space.start),
    }


@_encode.register
def _(space: spaces.MultiBinary, depth: int) -> dict[str, object]:
    n = space.n
    return {"kind": "multi_binary", "n": tuple(map(int, n)) if isinstance(n, tuple) else int(n)}


@_encode.register
def _(space: spaces.Text, depth: int) -> dict[str, object]:
    characters = "".join(dict.fromkeys(space.character_list))
    if not _is_charset(characters) or len(characters) != len(space.character_set):
        return _encode.dispatch(object)(space, depth)
    return {
        "kind": "text",
        "min_length": int(space.min_length),
        "max_length": int(space.max_length),
        "characters": characters,
    }


@_encode.register
def _(space: spaces.Dict, depth: int) -> dict[str, object]:
    return {
        "kind": "dict",
        "keys": list(space.spaces),
        "spaces": _encode_all(space.spaces.values(), depth),
        "sort_keys": bool(getattr(space, "sort_keys", True)),
    }


@_encode.register(spaces.Tuple)
def _(space: spaces.Tuple[Any], depth: int) -> dict[str, object]:
    return {"kind": "tuple", "spaces": _encode_all(space.spaces, depth)}


@_encode.register
def _(space: spaces.Sequence, depth: int) -> dict[str, object]:
    return {
        "kind": "sequence",
        "space": _encode_child(space.feature_space, depth),
        "stack": bool(space.stack),
    }


@_encode.register
def _(space: spaces.Graph, depth: int) -> dict[str, object]:
    edge = space.edge_space
    return {
        "kind": "graph",
        "node": _encode_child(space.node_space, depth),
        "edge": None if edge is None else _encode_child(edge, depth),
    }


def _encode_one_of(space: Any, depth: int) -> dict[str, object]:
    return {"kind": "one_of", "spaces": _encode_all(space.spaces, depth)}


# Gymnasium 0.29 has none.
_OneOf: Any = getattr(spaces, "OneOf", None)
if _OneOf is not None:
    _encode.register(_OneOf, _encode_one_of)


def _encode_child(space: Space, depth: int) -> dict[str, object]:
    if depth == MAX_SPACE_DEPTH:
        raise LocalProtocolError(f"Spaces are nested deeper than {MAX_SPACE_DEPTH}.")
    return _encode(space, depth + 1)


def _encode_all(children: Any, depth: int) -> list[dict[str, object]]:
    return [_encode_child(child, depth) for child in children]


def _compact(array: NDArray[Any]) -> NDArray[Any]:
    """Drops leading axes along which all slices are equal; uniform bounds become 0-d."""
    array = np.asarray(array)
    if not array.size:
        return np.zeros((), array.dtype)
    while array.ndim and (array == array[0]).all():
        array = array[0]
    return np.asarray(array)


# --- decoding -----------------------------------------------------------------------------------


def decode_space(value: object, *, max_elements: int) -> Space:
    """Builds the space that ``encode_space`` described.

    Trust: input from the worker.

    Args:
        value: What the wire brought.
        max_elements: Elements of all spaces in it together, counted before any is built. One
            element of a Box takes about ten bytes of bounds.

    Raises:
        RemoteProtocolError: Malformed, contradictory, or over ``max_elements``.
    """
    try:
        return _SpaceReader(max_elements).read(value, 0)
    except RemoteProtocolError:
        raise
    except Exception as error:
        # Gymnasium's constructors refuse in many ways; whatever they raise, the peer is wrong.
        raise RemoteProtocolError(f"Gymnasium refuses the described space: {error}") from error


class _SpaceReader:
    """Builds one nested space and counts its elements."""

    __slots__ = ("_left", "_max_elements")

    def __init__(self, max_elements: int) -> None:
        self._left = self._max_elements = max_elements

    def read(self, value: object, depth: int) -> Space:
        if type(value) is not dict or type(value.get("kind")) is not str:
            raise RemoteProtocolError("A space is not described by a map with a kind.")
        names, build = _KINDS.get(value["kind"], ((), None))
        if build is None:
            raise RemoteProtocolError("A space is of an unknown kind.")
        if value.keys() != {"kind", *names}:
            raise RemoteProtocolError(f"A space of kind {value['kind']} has wrong attributes.")
        return build(self, depth, *(value[name] for name in names))

    def child(self, value: object, depth: int) -> Space:
        if depth == MAX_SPACE_DEPTH:
            raise RemoteProtocolError(f"Spaces are nested deeper than {MAX_SPACE_DEPTH}.")
        return self.read(value, depth + 1)

    def children(self, value: object, depth: int) -> list[Space]:
        if type(value) is not list or len(value) > MAX_CHILDREN:
            raise RemoteProtocolError("A space's parts are not a list of sane length.")
        return [self.child(part, depth) for part in value]

    def spend(self, elements: int) -> None:
        """Raises ``RemoteProtocolError`` when this many elements are too many."""
        self._left -= elements
        if self._left < 0:
            raise RemoteProtocolError(
                f"The spaces have more than {self._max_elements} elements (max_elements)."
            )

    def shape(self, value: object) -> tuple[int, ...]:
        """Checks a shape and pays for its elements."""
        if not _is_shape(value):
            raise RemoteProtocolError("A space's shape is not a tuple of sizes.")
        # Sizes of 0 must not hide absurd ones: numpy multiplies the others.
        self.spend(max(1, math.prod(size for size in value if size)))
        return value

    def length(self, value: object, least: int) -> int:
        """Checks a number of elements without paying for it."""
        size = _integer(value, least, MAX_INT64)
        if size > self._max_elements:
            self.spend(size)
        return size


def _read_opaque(
    reader: _SpaceReader, depth: int, name: object, text: object, shape: object, dtype: object
) -> Space:
    if not (type(name) is type(text) is type(dtype) is str):
        raise RemoteProtocolError("A custom space is not described by text.")
    if shape is not None and not _is_shape(shape):
        raise RemoteProtocolError("A custom space's shape is not a tuple of sizes.")
    reader.spend(1)
    return OpaqueSpace(
        one_line(name, MAX_NAME_CHARS), one_line(text), shape, one_line(dtype, MAX_NAME_CHARS)
    )


def _read_box(
    reader: _SpaceReader,
    depth: int,
    name: object,
    shape: object,
    low: object,
    high: object,
    below: object,
    above: object,
) -> Space:
    dtype, size = _dtype(name, _BOX_DTYPES), reader.shape(shape)
    bounds = [_expand(bound, size, dtype) for bound in (low, high)]
    masks = [_expand(mask, size, np.dtype(bool)) for mask in (below, above)]
    box = spaces.Box(low=bounds[0], high=bounds[1], shape=size, dtype=dtype.type)
    # Integer bounds cannot say "infinite"; these two do, and decide how samples are drawn.
    box.bounded_below, box.bounded_above = masks[0].copy(), masks[1].copy()
    return box


def _read_discrete(
    reader: _SpaceReader, depth: int, n: object, start: object, name: object
) -> Space:
    dtype = _dtype(name, _INTEGER_DTYPES)
    least, most = _integer_range(dtype)
    count, first = _integer(n, 1, most), _integer(start, least, most)
    if first + count - 1 > most:
        raise RemoteProtocolError("A Discrete space ends beyond its dtype.")
    reader.spend(1)
    if not _DISCRETE_HAS_DTYPE:
        return spaces.Discrete(count, start=first)
    return spaces.Discrete(count, start=first, dtype=dtype.type)


def _read_multi_discrete(
    reader: _SpaceReader, depth: int, name: object, shape: object, nvec: object, start: object
) -> Space:
    dtype, size = _dtype(name, _INTEGER_DTYPES), reader.shape(shape)
    counts, first = _expand(nvec, size, dtype), _expand(start, size, dtype)
    return spaces.MultiDiscrete(counts.copy(), dtype=dtype.type, start=first.copy())


def _read_multi_binary(reader: _SpaceReader, depth: int, n: object) -> Space:
    if isinstance(n, tuple):
        return spaces.MultiBinary(list(reader.shape(n)))
    size = _integer(n, 1, MAX_INT64)
    reader.spend(size)
    return spaces.MultiBinary(size)


def _read_text(
    reader: _SpaceReader, depth: int, shortest: object, longest: object, characters: object
) -> Space:
    if type(characters) is not str or not _is_charset(characters):
        raise RemoteProtocolError("A Text space's characters are not distinct characters.")
    reader.spend(1 + len(characters))
    return spaces.Text(
        max_length=reader.length(longest, 0),
        min_length=reader.length(shortest, 0),
        charset=characters,
    )


def _read_dict(
    reader: _SpaceReader, depth: int, keys: object, parts: object, sort_keys: object
) -> Space:
    if type(keys) is not list or len(keys) > MAX_KEYS or type(sort_keys) is not bool:
        raise RemoteProtocolError("A Dict space's keys are not a list of sane length.")
    children = reader.children(parts, depth)
    if not len(set(keys)) == len(keys) == len(children):
        raise RemoteProtocolError("A Dict space has a key twice, or not one key per part.")
    # Pairs keep their order; Gymnasium sorts plain mappings.
    space = spaces.Dict(list(zip(keys, children, strict=True)))
    if hasattr(space, "sort_keys"):
        space.sort_keys = sort_keys
    return space


def _read_tuple(reader: _SpaceReader, depth: int, parts: object) -> Space:
    return spaces.Tuple(reader.children(parts, depth))


def _read_one_of(reader: _SpaceReader, depth: int, parts: object) -> Space:
    children = reader.children(parts, depth)
    if _OneOf is None:
        return OpaqueSpace("gymnasium.spaces.OneOf", one_line(f"OneOf({children})"))
    space: Space = _OneOf(children)
    return space


def _read_sequence(reader: _SpaceReader, depth: int, part: object, stack: object) -> Space:
    if type(stack) is not bool:
        raise RemoteProtocolError("A Sequence space's stack flag is not a boolean.")
    return spaces.Sequence(_read_twice(reader, part, depth), stack=stack)


def _read_graph(reader: _SpaceReader, depth: int, node: object, edge: object) -> Space:
    nodes: Any = _read_twice(reader, node, depth)
    edges: Any = None if edge is None else _read_twice(reader, edge, depth)
    return spaces.Graph(nodes, edges)


def _read_twice(reader: _SpaceReader, part: object, depth: int) -> Space:
    """Reads a space of which Gymnasium keeps a batch of one besides, and pays for both."""
    before = reader._left
    space = reader.child(part, depth)
    reader.spend(before - reader._left)
    return space


_KINDS: dict[str, tuple[tuple[str, ...], Callable[..., Space]]] = {
    "opaque": (("type", "text", "shape", "dtype"), _read_opaque),
    "box": (("dtype", "shape", "low", "high", "bounded_below", "bounded_above"), _read_box),
    "discrete": (("n", "start", "dtype"), _read_discrete),
    "multi_discrete": (("dtype", "shape", "nvec", "start"), _read_multi_discrete),
    "multi_binary": (("n",), _read_multi_binary),
    "text": (("min_length", "max_length", "characters"), _read_text),
    "dict": (("keys", "spaces", "sort_keys"), _read_dict),
    "tuple": (("spaces",), _read_tuple),
    "one_of": (("spaces",), _read_one_of),
    "sequence": (("space", "stack"), _read_sequence),
    "graph": (("node", "edge"), _read_graph),
}


def _is_shape(value: object) -> TypeGuard[tuple[int, ...]]:
    """Says whether this is a tuple of sizes that numpy can take."""
    return (
        type(value) is tuple
        and len(value) <= MAX_DIMENSIONS
        and all(type(size) is int and 0 <= size < 2**31 for size in value)
    )


def _is_charset(characters: str) -> bool:
    lone_surrogate = any("\ud800" <= char <= "\udfff" for char in characters)
    return len(set(characters)) == len(characters) and not lone_surrogate


def _integer(value: object, least: int, most: int) -> int:
    if type(value) is not int or not least <= value <= most:
        raise RemoteProtocolError("A space's number is not an integer in its range.")
    return value


def _integer_range(dtype: np.dtype[Any]) -> tuple[int, int]:
    info = np.iinfo(dtype)
    return int(info.min), min(int(info.max), MAX_INT64)


def _dtype(name: object, allowed: dict[str, np.dtype[Any]]) -> np.dtype[Any]:
    if type(name) is not str or name not in allowed:
        raise RemoteProtocolError("A space's dtype is not on the list.")
    return allowed[name]


def _expand(value: object, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Undoes ``_compact``. The result shares memory with itself: copy it before writing."""
    if not isinstance(value, np.ndarray) or value.dtype != dtype:
        raise RemoteProtocolError("A space's bounds are not an array of its dtype.")
    if value.ndim and value.shape != shape[len(shape) - value.ndim :]:
        raise RemoteProtocolError("A space's bounds do not fit its shape.")
    return np.broadcast_to(value, shape)
