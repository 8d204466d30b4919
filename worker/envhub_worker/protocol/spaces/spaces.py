"""Gymnasium spaces to plain values; ``reader.py`` reads them back.

Works with Gymnasium 0.26 to 1.4, which may differ between the two ends.

A space that its author has seeded draws the same samples in each run, and so must its copy in the
client: the description includes the states of its generators. The state of an unseeded generator is
left out: the client remembers descriptions, and every run would draw the same samples.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import singledispatch
from typing import Any, NoReturn, TypeGuard

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from envhub_worker.protocol.codec.arrays import MAX_DIMENSIONS
from envhub_worker.protocol.codec.inert import MAX_NAME_CHARS, inert_copy, one_line
from envhub_worker.protocol.errors import LocalProtocolError

# A nested space takes two containers of the wire's depth of 32; messages need some around it.
MAX_SPACE_DEPTH = 12

_DTYPE_CODES = ("?", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8")
BOX_DTYPES = {np.dtype(code).name: np.dtype(code) for code in _DTYPE_CODES}
"""By name. Their order is that of the codes of actions in shared memory."""
INTEGER_DTYPES = {name: dtype for name, dtype in BOX_DTYPES.items() if dtype.kind in "iu"}

ARRAY_SPACES = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
"""Whose members are arrays or numbers, and whose batches are one array."""
FIELDS = {
    "opaque": ("type", "text", "shape", "dtype"),
    "box": ("dtype", "shape", "low", "high", "bounded_below", "bounded_above"),
    "discrete": ("n", "start", "dtype"),
    "multi_discrete": ("dtype", "shape", "nvec", "start"),
    "multi_binary": ("n",),
    "text": ("min_length", "max_length", "characters"),
    "dict": ("keys", "spaces", "sort_keys"),
    "tuple": ("spaces",),
    "one_of": ("spaces",),
    "sequence": ("space", "stack"),
    "graph": ("node", "edge"),
}
"""By the kind of a space: what describes it, beside the kind."""

GENERATORS = "generators"
"""The key of what the generators of a space and its parts are to begin with."""

NUMBER = "number"
"""The key of a number that a space keeps, so that the client knows it again in another answer. In
the client it is an attribute of the new space: the number, and the states that came with it.
"""

# Gymnasium 0.29 has none.
OneOf: Any = getattr(spaces, "OneOf", None)


class OpaqueSpace(gym.Space[Any]):
    """Stands for a space of the peer that Gymnasium does not know.

    It has a ``repr``, can be compared and batched, and supports nothing else.

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

    def _refuse(self, complaint: str) -> NoReturn:
        raise gym.error.CustomSpaceError(
            f"Cannot {complaint} {self.type_name}: its code exists only inside the sandbox. "
            "Build values for it yourself, or call the environment's own method for it."
        )


class EscapedText(spaces.Text):
    """A Text of the peer with control characters, which Gymnasium would print as they are."""

    def __repr__(self) -> str:
        return f"Text({self.min_length}, {self.max_length}, charset={self.characters!r})"


def is_shape(value: object) -> TypeGuard[tuple[int, ...]]:
    """Says whether this is a tuple of sizes that numpy can take."""
    return (
        type(value) is tuple
        and len(value) <= MAX_DIMENSIONS
        and all(type(size) is int and 0 <= size < 2**31 for size in value)
    )


def is_charset(characters: str) -> bool:
    """Says whether these are distinct characters that UTF-8 can carry."""
    lone_surrogate = any("\ud800" <= char <= "\udfff" for char in characters)
    return len(set(characters)) == len(characters) and not lone_surrogate


Space = gym.Space[Any]
States = list[Any]
_CHANCE_BITS = 64
"""The entropy of a seed; what the operating system gives has twice as many bits."""
BIT_GENERATORS = (
    np.random.PCG64,
    np.random.PCG64DXSM,
    np.random.MT19937,
    np.random.Philox,
    np.random.SFC64,
)


def seeded_nodes(space: Space) -> Iterator[Space]:
    """Returns a space and all spaces in it, in a fixed order."""
    yield space
    for child in _parts_of(space):
        yield from seeded_nodes(child)


def seeded_states(space: Space, single: Space | None = None) -> States | None:
    """Returns the initial generator state of each node, None for a node that was not seeded.

    A number in place of a state means that the node shares the generator of that earlier node.

    Args:
        space: The space.
        single: The space that ``space`` is a batch of, or None. Gymnasium seeds copies of some
            spaces in a batch, at random if the single space is not seeded.

    Returns:
        None if no node is seeded.
    """
    known = (*ARRAY_SPACES, spaces.Dict, spaces.Tuple)  # seeded in a batch only if they are
    for node in seeded_nodes(single) if single is not None else ():
        if not isinstance(node, known) and _state(node) is None:
            return None
    states: States = []
    first: dict[int, int] = {}
    for index, node in enumerate(seeded_nodes(space)):
        state = _state(node)
        # For a shared generator: the index of the first node that has it.
        sharer = first.setdefault(id(getattr(node, "_np_random", None)), index)
        states.append(state if state is None or sharer == index else sharer)
    return states if any(state is not None for state in states) else None


def _parts_of(space: Space) -> tuple[Space, ...]:
    if isinstance(space, spaces.Dict):
        return tuple(space.spaces.values())
    if isinstance(space, spaces.Tuple) or (OneOf is not None and isinstance(space, OneOf)):
        return tuple(space.spaces)
    if isinstance(space, spaces.Sequence):
        return (space.feature_space,)
    if isinstance(space, spaces.Graph):
        return (space.node_space, *(() if space.edge_space is None else (space.edge_space,)))
    return ()


def entropy_of(bits: Any) -> Any:
    """The entropy that seeded a bit generator. The attribute has another name before numpy 1.25."""
    sequence = getattr(bits, "seed_seq", None) or getattr(bits, "_seed_seq", None)
    return getattr(sequence, "entropy", None)


def _state(space: Space) -> Any:
    """Returns a generator's state; None without a generator or if it was seeded at random."""
    generator = getattr(space, "_np_random", None)
    if type(generator) is not np.random.Generator:
        return None
    bits = generator.bit_generator
    if type(bits) not in BIT_GENERATORS:
        return None
    entropy = entropy_of(bits)
    if entropy is None or (isinstance(entropy, int) and entropy.bit_length() > _CHANCE_BITS):
        return None
    return bits.state


def encode_space(
    space: Space, *, seeded: bool = False, single: Space | None = None
) -> dict[str, object]:
    """Describes a space by plain values and arrays.

    A subclass is described as its nearest Gymnasium base, any other custom space by its type
    and ``repr``.

    Args:
        space: The space.
        seeded: Whether to describe the generators of seeded spaces, too.
        single: The space that ``space`` is a batch of, or None.

    Raises:
        LocalProtocolError: Spaces nested deeper than 12.
    """
    described = _encode(space, 0)
    states = seeded_states(space, single) if seeded else None
    return described if states is None else {**described, GENERATORS: states}


def _encode(space: Any, depth: int) -> dict[str, object]:
    kind, *values = _fields(space, depth)
    return {"kind": kind, **dict(zip(FIELDS[kind], values, strict=True))}


@singledispatch
def _fields(space: Any, depth: int) -> tuple[Any, ...]:
    """The kind of a space, and the values of that kind's ``FIELDS``."""
    about = inert_copy(space)
    shape = getattr(space, "shape", None)
    dtype = getattr(space, "dtype", None)
    dtype_text = "" if dtype is None else one_line(str(dtype), MAX_NAME_CHARS)
    shape = shape if is_shape(shape) else None
    return "opaque", about.type_name, about.text, shape, dtype_text


_opaque_fields = _fields.dispatch(object)
# Each ``register`` below names its class: to read the classes from annotations would take as long
# as the whole rest of this import.


@_fields.register(OpaqueSpace)
def _(space: OpaqueSpace, depth: int) -> tuple[Any, ...]:
    return "opaque", space.type_name, space.text, space.shape, space.dtype_text


@_fields.register(spaces.Box)
def _(space: spaces.Box, depth: int) -> tuple[Any, ...]:
    if space.dtype.name not in BOX_DTYPES:
        return _opaque_fields(space, depth)
    arrays = (space.low, space.high, space.bounded_below, space.bounded_above)
    return "box", space.dtype.name, space.shape, *map(_compact, arrays)


@_fields.register(spaces.Discrete)
def _(space: spaces.Discrete, depth: int) -> tuple[Any, ...]:
    return "discrete", int(space.n), int(space.start), np.dtype(space.dtype).name


@_fields.register(spaces.MultiDiscrete)
def _(space: spaces.MultiDiscrete, depth: int) -> tuple[Any, ...]:
    name, shape = np.dtype(space.dtype).name, space.nvec.shape
    return "multi_discrete", name, shape, _compact(space.nvec), _compact(space.start)


@_fields.register(spaces.MultiBinary)
def _(space: spaces.MultiBinary, depth: int) -> tuple[Any, ...]:
    n = space.n
    return "multi_binary", tuple(map(int, n)) if isinstance(n, tuple) else int(n)


@_fields.register(spaces.Text)
def _(space: spaces.Text, depth: int) -> tuple[Any, ...]:
    characters = "".join(dict.fromkeys(space.character_list))
    if not is_charset(characters) or len(characters) != len(space.character_set):
        return _opaque_fields(space, depth)
    return "text", int(space.min_length), int(space.max_length), characters


@_fields.register(spaces.Dict)
def _(space: spaces.Dict, depth: int) -> tuple[Any, ...]:
    parts = _encode_all(space.spaces.values(), depth)
    return "dict", list(space.spaces), parts, bool(getattr(space, "sort_keys", True))


@_fields.register(spaces.Tuple)
def _(space: spaces.Tuple[Any], depth: int) -> tuple[Any, ...]:
    return "tuple", _encode_all(space.spaces, depth)


@_fields.register(spaces.Sequence)
def _(space: spaces.Sequence, depth: int) -> tuple[Any, ...]:
    return "sequence", _encode_child(space.feature_space, depth), bool(space.stack)


@_fields.register(spaces.Graph)
def _(space: spaces.Graph, depth: int) -> tuple[Any, ...]:
    edge = space.edge_space
    node = _encode_child(space.node_space, depth)
    return "graph", node, None if edge is None else _encode_child(edge, depth)


if OneOf is not None:

    @_fields.register(OneOf)
    def _(space: Any, depth: int) -> tuple[Any, ...]:
        return "one_of", _encode_all(space.spaces, depth)


def _encode_child(space: Space, depth: int) -> dict[str, object]:
    if depth == MAX_SPACE_DEPTH:
        raise LocalProtocolError(f"Spaces are nested deeper than {MAX_SPACE_DEPTH}.")
    return _encode(space, depth + 1)


def _encode_all(children: Iterable[Space], depth: int) -> list[dict[str, object]]:
    return [_encode_child(child, depth) for child in children]


def _compact(array: NDArray[Any]) -> NDArray[Any]:
    """Drops leading axes along which all slices are equal; uniform bounds become 0-d."""
    array = np.asarray(array)
    if not array.size:
        return np.zeros((), array.dtype)
    while array.ndim and (array == array[0]).all():
        array = array[0]
    return np.asarray(array)
