"""Gymnasium spaces as plain values, and back with every claim checked.

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

from envhub_worker.protocol.codec.inert import MAX_NAME_CHARS, describe, one_line
from envhub_worker.protocol.errors import LocalProtocolError
from envhub_worker.protocol.spaces.opaque import (
    BOX_DTYPES,
    MAX_SPACE_DEPTH,
    OneOf,
    OpaqueSpace,
    is_charset,
    is_shape,
)
from envhub_worker.protocol.spaces.reader import GENERATORS, decode_space
from envhub_worker.protocol.spaces.seeded import states_of

__all__ = ["ARRAY_SPACES", "OpaqueSpace", "decode_space", "encode_space"]

Space = gym.Space[Any]
ARRAY_SPACES = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
"""Whose members are arrays or numbers, and whose batches are one array."""


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
    states = states_of(space, single) if seeded else None
    return described if states is None else {**described, GENERATORS: states}


@singledispatch
def _encode(space: Any, depth: int) -> dict[str, object]:
    about = describe(space)
    shape = getattr(space, "shape", None)
    dtype = getattr(space, "dtype", None)
    return {
        "kind": "opaque",
        "type": about.type_name,
        "text": about.text,
        "shape": shape if is_shape(shape) else None,
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
    if space.dtype.name not in BOX_DTYPES:
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
    if not is_charset(characters) or len(characters) != len(space.character_set):
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


if OneOf is not None:
    _encode.register(OneOf, _encode_one_of)


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
