"""Copies of an environment's results, made before it or a sibling is called again.

Many environments fill one mapping or one array again and again.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

_DEPTH = 32
"""What lies deeper cannot be sent, and may be endless."""
_FLAT = frozenset({bool, int, float, str, type(None), np.bool_})
_FLAT |= {np.dtype(char).type for char in "bBhHiIlLqQefd"}


def taken(info: dict[Any, Any], depth: int = _DEPTH) -> dict[Any, Any]:
    """Copies the mappings and arrays of an info, which ``VectorEnv._add_info`` copies, too.

    Gymnasium keeps references to other objects and to a ``final_obs``, so these are sent as they
    are at that moment.
    """
    if type(info) is not dict:
        info = dict(info.items())
    if not depth or _FLAT.issuperset(map(type, info.values())):
        return info.copy()
    return {
        key: taken(value, depth - 1)
        if isinstance(value, dict)
        else _array(value)
        if isinstance(value, np.ndarray) and key != "final_obs"
        else value
        for key, value in info.items()
    }


def _array(value: Any) -> Any:
    """Copies an array; a masked number is nan, as in a column."""
    if type(value) is np.ndarray:
        return np.array(value)
    copy = np.zeros(value.shape, value.dtype)
    copy[()] = value
    return copy


def kept(value: Any, depth: int = _DEPTH, seen: dict[int, Any] | None = None) -> Any:
    """Copies a value with all containers and arrays in it."""
    seen = {} if seen is None else seen
    if id(value) in seen or not depth:
        return seen.get(id(value), value)
    if isinstance(value, dict):
        copy: dict[Any, Any] = {}
        seen[id(value)] = copy
        copy.update((key, kept(member, depth - 1, seen)) for key, member in value.items())
        return copy
    if isinstance(value, (list, tuple)):
        members: list[Any] = []
        seen[id(value)] = members
        members += [kept(member, depth - 1, seen) for member in value]
        seen[id(value)] = copied = members if isinstance(value, list) else tuple(members)
        return copied
    if isinstance(value, (np.ndarray, set)):
        return value.copy()
    torch = sys.modules.get("torch")
    is_tensor = torch is not None and isinstance(value, getattr(torch, "Tensor", ()))
    return value.detach().clone() if is_tensor else value
