"""Gymnasium spaces from plain values, with every claim checked before anything is built."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from inspect import signature
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from envhub_worker.protocol.codec.inert import MAX_NAME_CHARS, one_line
from envhub_worker.protocol.errors import EnvHubError, RemoteProtocolError
from envhub_worker.protocol.spaces.spaces import (
    BOX_DTYPES,
    FIELDS,
    GENERATORS,
    INTEGER_DTYPES,
    MAX_SPACE_DEPTH,
    NUMBER,
    EscapedText,
    OneOf,
    OpaqueSpace,
    is_charset,
    is_shape,
    seeded_nodes,
)

# Children of one Dict, Tuple or OneOf; a batch of custom spaces is a Tuple of as many.
MAX_CHILDREN = 65_536
# Keys of one Dict. An attacker can make keys other than text collide.
MAX_KEYS = 4096
MAX_INT64 = 2**63 - 1

ELEMENT_BYTES = 10
"""One element of a float32 Box: two bounds, and whether they are finite. Smaller ones cost as much
time, so none is cheaper."""
SPACE_BYTES = 1024
"""A space without elements: objects of Python."""
CHARACTER_BYTES = 256
"""One character of a Text's set, which stands in a set, a list and a dict."""
GENERATOR_BYTES = 4 * SPACE_BYTES
"""The largest state of a generator, and the objects around it."""
_SHARED_BYTES = 256

_DISCRETE_HAS_DTYPE = "dtype" in signature(spaces.Discrete.__init__).parameters

Space = gym.Space[Any]
GeneratorMaker = Callable[[object], np.random.Generator]


class SpaceReader:
    """Builds spaces within one budget of bytes, which is charged before anything is built.

    The budget covers the memory of each space and of one sample. Boxes with equal descriptions
    share their bounds and pay for them once: most tasks of a suite have equal spaces.

    Args:
        max_elements: The budget, in elements of a float32 Box, each ``ELEMENT_BYTES``.
        check: Called before each space is built; may raise to end the reading.
        generator: Checks a state and makes a generator from it. Without it, states are refused.
    """

    __slots__ = ("_boxes", "_check", "_depth", "_generator", "_left", "_max_elements", "_twice")

    def __init__(
        self,
        max_elements: int,
        check: Callable[[], None] | None = None,
        generator: GeneratorMaker | None = None,
    ) -> None:
        self._generator = generator
        self._left, self._max_elements = max_elements * ELEMENT_BYTES, max_elements
        self._check = check
        self._boxes: dict[tuple[object, ...], spaces.Box] = {}
        self._depth, self._twice = 0, False

    def space(self, value: object) -> Space:
        """Reads the next space. Trust: input from the worker.

        Raises:
            RemoteProtocolError: Malformed, contradictory, or over ``max_elements``.
        """
        self._depth, self._twice = 0, False
        try:
            if self._generator is None or type(value) is not dict:
                return self.read(value)
            about = {k: part for k, part in value.items() if k in (GENERATORS, NUMBER)}
            space = self.read({k: part for k, part in value.items() if k not in about})
            if GENERATORS in about:
                self._start(space, about[GENERATORS], self._generator)
            if NUMBER in about:
                number = _integer(about[NUMBER], 0, MAX_INT64)
                vars(space)[NUMBER] = number, about.get(GENERATORS, [])
            return space
        except EnvHubError:
            raise
        except Exception as error:
            # Gymnasium's constructors refuse in many ways; whatever they raise, the peer is wrong.
            text = f"Gymnasium refuses the described space: {one_line(str(error))}"
            raise RemoteProtocolError(text) from error

    def _start(self, space: Space, states: object, generator: GeneratorMaker) -> None:
        """Give a space and its parts generators in the states of the worker's generators."""
        parts = list(seeded_nodes(space))
        if type(states) is not list or len(states) != len(parts):
            raise RemoteProtocolError("A space does not have one generator for each part.")
        for index, (part, state) in enumerate(zip(parts, states, strict=True)):
            if type(state) is int and 0 <= state < index:
                part._np_random = parts[state]._np_random
            elif state is not None:
                self.spend(GENERATOR_BYTES)
                part._np_random = generator(state)

    def read(self, value: object) -> Space:
        """Reads one space and all spaces in it."""
        if self._check is not None:
            self._check()
        self.spend(SPACE_BYTES)
        if type(value) is not dict or type(value.get("kind")) is not str:
            raise RemoteProtocolError("A space is not described by a map with a kind.")
        build, names = _BUILDERS.get(value["kind"]), FIELDS.get(value["kind"], ())
        if build is None:
            raise RemoteProtocolError("A space is of an unknown kind.")
        if value.keys() != {"kind", *names}:
            raise RemoteProtocolError(f"A space of kind {value['kind']} has wrong attributes.")
        return build(self, *(value[name] for name in names))

    def child(self, value: object) -> Space:
        """Reads one child of the current space."""
        if self._depth == MAX_SPACE_DEPTH:
            raise RemoteProtocolError(f"Spaces are nested deeper than {MAX_SPACE_DEPTH}.")
        self._depth += 1
        space = self.read(value)
        self._depth -= 1
        return space

    def children(self, value: object) -> list[Space]:
        """Reads all children of the current space."""
        if type(value) is not list or len(value) > MAX_CHILDREN:
            raise RemoteProtocolError("A space's parts are not a list of sane length.")
        return list(map(self.child, value))

    def child_twice(self, value: object) -> Space:
        """Reads a child of which Gymnasium also keeps a batch of one; pays for both."""
        before, within = self._left, self._twice
        self._twice = True  # that batch has bounds of its own
        space = self.child(value)
        self._twice = within
        self.spend(before - self._left)
        return space

    def spend(self, size: int) -> None:
        """Raises ``RemoteProtocolError`` when this many bytes are too many."""
        self._left -= size
        if self._left < 0:
            raise RemoteProtocolError(
                f"The spaces and sub-environments cost more than {self._max_elements} elements of "
                'a Box. If this is intended, raise the limit: limits={"elements": ...}, or '
                "message_bytes for spaces in an answer"
            )

    def shape(self, value: object, element_bytes: int) -> tuple[int, ...]:
        """Checks a shape and pays for its elements."""
        if not is_shape(value):
            raise RemoteProtocolError("A space's shape is not a tuple of sizes.")
        # Sizes of 0 must not hide absurd ones: numpy multiplies the others.
        count = max(1, math.prod(size for size in value if size))
        self.spend(count * max(ELEMENT_BYTES, element_bytes))
        return value

    def like(self, key: tuple[object, ...]) -> spaces.Box | None:
        """Makes another Box with the bounds of the first Box of the same description."""
        twin = None if self._twice else self._boxes.get(key)
        if twin is None:
            return None
        another = copy.copy(twin)
        another._np_random = None  # type: ignore[assignment]  # that one draws by itself
        return another

    def keep(self, key: tuple[object, ...], box: spaces.Box) -> None:
        """Remembers a Box for later ones with the same description."""
        if not self._twice:
            self._boxes[key] = box


def _read_opaque(
    reader: SpaceReader, name: object, text: object, shape: object, dtype: object
) -> Space:
    if not (type(name) is type(text) is type(dtype) is str):
        raise RemoteProtocolError("A custom space is not described by text.")
    if shape is not None and not is_shape(shape):
        raise RemoteProtocolError("A custom space's shape is not a tuple of sizes.")
    return OpaqueSpace(
        one_line(name, MAX_NAME_CHARS), one_line(text), shape, one_line(dtype, MAX_NAME_CHARS)
    )


def _read_box(
    reader: SpaceReader,
    name: object,
    shape: object,
    low: object,
    high: object,
    below: object,
    above: object,
) -> Space:
    dtype = _dtype(name, BOX_DTYPES)
    key = _box_key(name, shape, low, high, below, above)
    twin = None if key is None else reader.like(key)
    if twin is not None:
        return twin
    size = reader.shape(shape, 2 * dtype.itemsize + 2)
    bounds = [_expand(bound, size, dtype) for bound in (low, high)]
    masks = [_expand(mask, size, np.dtype(bool)) for mask in (below, above)]
    # Refuses nan, too, which some versions of Gymnasium accept.
    if not (bounds[0] <= bounds[1]).all():
        raise RemoteProtocolError("A Box's low is not below its high.")
    box = spaces.Box(low=bounds[0], high=bounds[1], shape=size, dtype=dtype.type)
    # Integer bounds cannot say "infinite"; these two do, and decide how samples are drawn.
    box.bounded_below, box.bounded_above = masks[0].copy(), masks[1].copy()
    if key is not None:
        reader.keep(key, box)
    return box


def _box_key(name: object, shape: object, *arrays: object) -> tuple[object, ...] | None:
    """A cache key of a Box's description; None if the description is large or malformed."""
    key: list[object] = [name]
    if not is_shape(shape):
        return None
    for array in arrays:
        if type(array) is not np.ndarray or array.nbytes > _SHARED_BYTES:
            return None
        key += [array.dtype, array.shape, array.tobytes()]
    return (*key, shape)


def _read_discrete(reader: SpaceReader, n: object, start: object, name: object) -> Space:
    dtype = _dtype(name, INTEGER_DTYPES)
    info = np.iinfo(dtype)
    least, most = int(info.min), min(int(info.max), MAX_INT64)
    count, first = _integer(n, 1, most), _integer(start, least, most)
    if first + count - 1 > most:
        raise RemoteProtocolError("A Discrete space ends beyond its dtype.")
    if not _DISCRETE_HAS_DTYPE:
        return spaces.Discrete(count, start=first)
    return spaces.Discrete(count, start=first, dtype=dtype.type)


def _read_multi_discrete(
    reader: SpaceReader, name: object, shape: object, nvec: object, start: object
) -> Space:
    dtype = _dtype(name, INTEGER_DTYPES)
    # Pays for the bounds; a sample takes as many bytes again.
    size = reader.shape(shape, 4 * dtype.itemsize)
    counts, first = _expand(nvec, size, dtype), _expand(start, size, dtype)
    return spaces.MultiDiscrete(counts.copy(), dtype=dtype.type, start=first.copy())


def _read_multi_binary(reader: SpaceReader, n: object) -> Space:
    if isinstance(n, tuple):
        return spaces.MultiBinary(list(reader.shape(n, ELEMENT_BYTES)))
    size = _integer(n, 1, MAX_INT64)
    reader.spend(size * ELEMENT_BYTES)
    return spaces.MultiBinary(size)


def _read_text(reader: SpaceReader, shortest: object, longest: object, characters: object) -> Space:
    if type(characters) is not str or not is_charset(characters):
        raise RemoteProtocolError("A Text space's characters are not distinct characters.")
    reader.spend(CHARACTER_BYTES * len(characters))
    most = _integer(longest, 0, MAX_INT64)
    reader.spend(most * ELEMENT_BYTES)  # it is a text of so many characters that is drawn
    kind = spaces.Text if characters.isprintable() else EscapedText
    return kind(max_length=most, min_length=_integer(shortest, 0, MAX_INT64), charset=characters)


def _read_dict(reader: SpaceReader, keys: object, parts: object, sort_keys: object) -> Space:
    if type(keys) is not list or len(keys) > MAX_KEYS or type(sort_keys) is not bool:
        raise RemoteProtocolError("A Dict space's keys are not a list of sane length.")
    children = reader.children(parts)
    if not len(set(keys)) == len(keys) == len(children):
        raise RemoteProtocolError("A Dict space has a key twice, or not one key per part.")
    # Pairs keep their order; Gymnasium sorts plain mappings.
    space = spaces.Dict(list(zip(keys, children, strict=True)))
    if hasattr(space, "sort_keys"):
        space.sort_keys = sort_keys
    return space


def _read_one_of(reader: SpaceReader, parts: object) -> Space:
    children = reader.children(parts)
    if OneOf is None:
        return OpaqueSpace("gymnasium.spaces.OneOf", one_line(f"OneOf({children})"))
    space: Space = OneOf(children)
    return space


def _read_sequence(reader: SpaceReader, part: object, stack: object) -> Space:
    if type(stack) is not bool:
        raise RemoteProtocolError("A Sequence space's stack flag is not a boolean.")
    return spaces.Sequence(reader.child_twice(part), stack=stack)


def _read_graph(reader: SpaceReader, node: object, edge: object) -> Space:
    nodes: Any = reader.child_twice(node)
    edges: Any = None if edge is None else reader.child_twice(edge)
    return spaces.Graph(nodes, edges)


_BUILDERS: dict[str, Callable[..., Space]] = {
    "opaque": _read_opaque,
    "box": _read_box,
    "discrete": _read_discrete,
    "multi_discrete": _read_multi_discrete,
    "multi_binary": _read_multi_binary,
    "text": _read_text,
    "dict": _read_dict,
    "tuple": lambda reader, parts: spaces.Tuple(reader.children(parts)),
    "one_of": _read_one_of,
    "sequence": _read_sequence,
    "graph": _read_graph,
}


def _integer(value: object, least: int, most: int) -> int:
    if type(value) is not int or not least <= value <= most:
        raise RemoteProtocolError("A space's number is not an integer in its range.")
    return value


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
