"""Gymnasium spaces to plain values; ``reader.py`` reads them back.

Works with Gymnasium 0.26 to 1.4, which may differ between the two ends.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import singledispatch
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from envhub_worker.protocol.codec.inert import MAX_NAME_CHARS, inert_copy, one_line
from envhub_worker.protocol.errors import LocalProtocolError
from envhub_worker.protocol.spaces.opaque import (
    ARRAY_SPACES,
    BOX_DTYPES,
    FIELDS,
    MAX_SPACE_DEPTH,
    OneOf,
    OpaqueSpace,
    is_charset,
    is_shape,
)
from envhub_worker.protocol.spaces.reader import GENERATORS
from envhub_worker.protocol.spaces.seeded import seeded_states

__all__ = ["ARRAY_SPACES", "OpaqueSpace", "encode_space"]

Space = gym.Space[Any]


def encode_space(
    space: Space, *, seeded: bool = False, single: Space | None = None
) -> dict[str, object]:
    """Describes a space by plain values and arrays.

    A subclass is described as its nearest Gymnasium base, any other custom space by its type
    and ``repr``.

    Args:
        space: The space.
        seeded: Whether the generators of seeded spaces are described, too.
        single: The space that it is a batch of, if it is.

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


@_fields.register
def _(space: OpaqueSpace, depth: int) -> tuple[Any, ...]:
    return "opaque", space.type_name, space.text, space.shape, space.dtype_text


@_fields.register
def _(space: spaces.Box, depth: int) -> tuple[Any, ...]:
    if space.dtype.name not in BOX_DTYPES:
        return _opaque_fields(space, depth)
    arrays = (space.low, space.high, space.bounded_below, space.bounded_above)
    return "box", space.dtype.name, space.shape, *map(_compact, arrays)


@_fields.register
def _(space: spaces.Discrete, depth: int) -> tuple[Any, ...]:
    return "discrete", int(space.n), int(space.start), np.dtype(space.dtype).name


@_fields.register
def _(space: spaces.MultiDiscrete, depth: int) -> tuple[Any, ...]:
    name, shape = np.dtype(space.dtype).name, space.nvec.shape
    return "multi_discrete", name, shape, _compact(space.nvec), _compact(space.start)


@_fields.register
def _(space: spaces.MultiBinary, depth: int) -> tuple[Any, ...]:
    n = space.n
    return "multi_binary", tuple(map(int, n)) if isinstance(n, tuple) else int(n)


@_fields.register
def _(space: spaces.Text, depth: int) -> tuple[Any, ...]:
    characters = "".join(dict.fromkeys(space.character_list))
    if not is_charset(characters) or len(characters) != len(space.character_set):
        return _opaque_fields(space, depth)
    return "text", int(space.min_length), int(space.max_length), characters


@_fields.register
def _(space: spaces.Dict, depth: int) -> tuple[Any, ...]:
    parts = _encode_all(space.spaces.values(), depth)
    return "dict", list(space.spaces), parts, bool(getattr(space, "sort_keys", True))


@_fields.register(spaces.Tuple)
def _(space: spaces.Tuple[Any], depth: int) -> tuple[Any, ...]:
    return "tuple", _encode_all(space.spaces, depth)


@_fields.register
def _(space: spaces.Sequence, depth: int) -> tuple[Any, ...]:
    return "sequence", _encode_child(space.feature_space, depth), bool(space.stack)


@_fields.register
def _(space: spaces.Graph, depth: int) -> tuple[Any, ...]:
    edge = space.edge_space
    node = _encode_child(space.node_space, depth)
    return "graph", node, None if edge is None else _encode_child(edge, depth)


if OneOf is not None:
    _fields.register(OneOf, lambda space, depth: ("one_of", _encode_all(space.spaces, depth)))


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
