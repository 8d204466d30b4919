"""Joins the infos of the workers that one ``recv`` returns.

Which workers come together depends on timing, so unlike the infos of a step, no worker's values may
decide the dtype of another's. Trust: input from the workers, of any form; within bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


def gather_infos(
    parts: Sequence[dict[Any, Any]], sizes: Sequence[int], max_bytes: int
) -> dict[Any, Any]:
    """Join the joined infos of several workers, none of which converts another's values.

    An entry becomes an object array of each sub-environment's own values if its dtype, shape or
    kind differs between parts, or if its column would take more than ``max_bytes``.
    """
    joined: dict[Any, Any] = {}
    start, count = 0, sum(sizes)
    for part, size in zip(parts, sizes, strict=True):
        _gather_part(joined, part, slice(start, start + size), count, max_bytes)
        start += size
    return joined


def _gather_part(
    joined: dict[Any, Any], part: dict[Any, Any], window: slice, count: int, max_bytes: int
) -> None:
    for key, value in part.items():
        column: Any = joined.get(key)
        if isinstance(value, dict) and (column is None or isinstance(column, dict)):
            _gather_part(joined.setdefault(key, {}), value, window, count, max_bytes)
            continue
        is_array = isinstance(value, np.ndarray)
        if column is None and is_array and value.nbytes * count <= max_bytes * len(value):
            column = joined[key] = _blank(value, count)
        if not (is_array and _is_like(column, value)):
            if not _is_like(column, _NOTHING):
                column = joined[key] = _members(joined, key, count)
            value = _members(part, key, window.stop - window.start)
        column[window] = value


_NOTHING = np.full(1, None, dtype=object)


def _is_like(column: Any, value: Any) -> bool:
    """Whether both are arrays with the same dtype and the same shape of a row."""
    if not isinstance(column, np.ndarray):
        return False
    return (column.dtype, column.shape[1:]) == (value.dtype, value.shape[1:])


def _members(infos: dict[Any, Any], key: Any, count: int) -> Any:
    """An entry's value for each sub-environment, object ``(count,)``; None if it has no value."""
    value: Any = infos.get(key)
    members = np.full(count, None, dtype=object)
    if value is None:
        return members
    if isinstance(value, dict):
        columns = {
            name: _members(value, name, count)
            for name in value
            # all but masks
            if not (type(name) is str and name[:1] == "_" and name[1:] in value)
        }
        value = [
            {name: column[index] for name, column in columns.items() if _has(value, name, index)}
            for index in range(count)
        ]
    for index in range(count):
        if _has(infos, key, index):
            members[index] = value[index]
    return members


def _has(infos: dict[Any, Any], key: Any, index: int) -> bool:
    """Whether a sub-environment set the entry. Trust: the mask may be any value."""
    mask: Any = infos.get(f"_{key}")
    is_mask = isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.ndim == 1
    return not is_mask or bool(mask[index])


def _blank(value: Any, count: int) -> Any:
    if value.dtype == object and value.ndim == 1:
        return np.full(count, None, dtype=object)
    return np.zeros((count, *value.shape[1:]), dtype=value.dtype)
