"""Joins the infos of shards, each of which sends those of its sub-environments unjoined.

The first sub-environment that has a key decides how its values are joined, so only the client can
join the infos of several shards. A shard's infos are columns if these lose nothing, else each has
its own place: see ``flat_infos`` and ``own_infos`` in ``protocol/spaces/batches``.
Trust: input from the worker; it is used within ``UNTRUSTED``.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np

from envhub_sandbox.errors import RemoteProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from envhub_worker.protocol.spaces import batches

Infos = dict[Any, Any]
OwnInfos = list[list[tuple[Infos, batches.Forms]]]
"""Each sub-environment's infos, in order, with their forms."""
_NUMBERS = frozenset("biuf")
_MOST_BYTES = DEFAULT_LIMITS.message_bytes
"""What infos of one shard may take here beyond the arrays that brought them, which may be empty."""
_VALUE_BYTES = 256
"""What one value takes as an object in a dict of its own."""


def read(parts: Sequence[Infos], sizes: Sequence[int]) -> tuple[Infos | None, OwnInfos]:
    """The infos of shards: all columns, if each shard has the same ones; else those of each
    sub-environment.
    """
    columns = _columns_of_all(parts, sizes)
    each = map(each_of, parts, sizes) if columns is None else ()
    return columns, [*chain.from_iterable(each)]


def without_classes(columns: Infos) -> Infos:
    """Columns as ``VectorEnv`` returns them."""
    return {key: column for key, column in columns.items() if type(key) is str}


def unjoined(each: OwnInfos) -> Infos:
    """The infos of several shards as one shard would send them."""
    pairs = [(index, *own) for index, some in enumerate(each) for own in some]
    own_pairs = [(index, info) for index, info, _ in pairs]
    return batches.own_infos(own_pairs, len(each), [form for _, _, form in pairs])


def joined(each: OwnInfos, max_bytes: int) -> Infos:
    """The infos as ``VectorEnv`` joins them; raises as ``join_pairs``."""
    pairs = [(index, info) for index, some in enumerate(each) for info, _ in some]
    forms = [form for some in each for _, form in some]
    return batches.join_pairs(pairs, len(each), max_bytes, forms)


def _columns_of_all(parts: Sequence[Infos], sizes: Sequence[int]) -> Infos | None:
    classes = parts[0].get(batches.APART_CLASSES)
    if classes is None or any(part.get(batches.APART_CLASSES) != classes for part in parts):
        return None
    _refuse_unless_few(_count(classes) * sum(sizes), 1)  # each column gets a mask
    columns = [{key: part[key] for key in part if key != batches.APART_CLASSES} for part in parts]
    joined = _joined_columns(columns, sizes, classes)
    return None if joined is None else {batches.APART_CLASSES: classes, **joined}


def _joined_columns(parts: Sequence[Infos], sizes: Sequence[int], classes: Any) -> Infos | None:
    _refuse_unless(all(type(each) is dict for each in (classes, *parts)), "of a known form")
    keys = [*parts[0]]
    if {*keys} != _names(classes) or any([*part] != keys for part in parts):
        return None
    joined: Infos = {}
    for key in keys:
        values = [part[key] for part in parts]
        if key not in classes:
            joined[key] = np.ones(sum(sizes), np.bool_)
        elif type(classes[key]) is dict:
            joined[key] = _joined_columns(values, sizes, classes[key])
        else:
            for part, size in zip(values, sizes, strict=True):
                _refuse_unless_column(part, size)
            first = values[0]
            is_alike = all(
                (part.dtype, part.shape[1:]) == (first.dtype, first.shape[1:]) for part in values
            )
            joined[key] = np.concatenate(values) if is_alike else None
        if joined[key] is None:
            return None
    return joined


def each_of(part: Infos, size: int) -> OwnInfos:
    """Each sub-environment's infos, from one shard."""
    own: OwnInfos = [[] for _ in range(size)]
    classes, forms = part.get(batches.APART_CLASSES, {}), part.get(batches.APART_FORMS, {})
    _refuse_unless(type(classes) is type(forms) is dict, "of a known form")
    _refuse_unless_few(_count(classes) * size)
    places = part.keys() - _names(classes)
    _refuse_unless(all(type(key) is int for key in places), "one mapping each")
    if classes:
        for some, row in zip(own, _rows(part, classes, size), strict=True):
            some.append((row, {}))
    for place in sorted(key for key in places if key >= 0):
        info, form = part[place], forms.get(place, {})
        _refuse_unless(type(info) is dict and place < 2 * size, "one mapping each")
        _refuse_unless(batches.are_forms(form), "of a known form")
        own[place % size].append((info, form))
    return own


def _names(classes: Infos) -> set[Any]:
    """The keys of columns, and of their masks."""
    return {name for key in classes for name in (key, f"_{key}")}


def _count(classes: Any) -> int:
    return sum(map(_count, classes.values())) if type(classes) is dict else 1


def _rows(part: Any, classes: Infos, size: int) -> list[Infos]:
    _refuse_unless(type(part) is dict, "of a known form")
    columns = [_members(part.get(key), has_numpys, size) for key, has_numpys in classes.items()]
    return [dict(zip(classes, row, strict=True)) for row in zip(*columns, strict=True)]


def _members(column: Any, has_numpys: Any, size: int) -> Any:
    if type(has_numpys) is dict:
        return _rows(column, has_numpys, size)
    _refuse_unless_column(column, size)
    if has_numpys:
        return list(column)
    _refuse_unless(column.ndim == 1, "one value each")  # Python's numbers are in no arrays
    return column.tolist()


def _refuse_unless_column(value: Any, size: int) -> None:
    is_column = type(value) is np.ndarray and value.shape[:1] == (size,)
    _refuse_unless(is_column and value.dtype.kind in _NUMBERS, "one value each")


def _refuse_unless_few(values: int, value_bytes: int = _VALUE_BYTES) -> None:
    most = _MOST_BYTES // value_bytes
    _refuse_unless(values <= most, f"at most {most} values, but {values}")


def _refuse_unless(holds: bool, claim: str) -> None:
    if not holds:
        raise RemoteProtocolError(f"the worker's infos are not {claim}")
