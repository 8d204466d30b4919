"""Joins the infos of shards, each of which sends those of its sub-environments unjoined.

The first sub-environment that has a key decides how its values are joined, so only the client can
join the infos of several shards. A shard's infos are columns if these lose nothing, else each has
its own place: see ``flat_infos`` and ``own_infos`` in ``protocol/spaces/batches``. Beside them may
be marks, such as that a sub-environment was restarted: arrays with masks.
Trust: input from the worker; it is used within ``UNTRUSTED``.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Any

import numpy as np

from envhub_sandbox.errors import RemoteProtocolError
from envhub_worker.protocol.spaces import batches

Infos = dict[Any, Any]
OwnInfos = list[list[tuple[Infos, batches.Forms]]]
"""Each sub-environment's infos, in order, with their forms."""
_NUMBERS = frozenset("biuf")


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
    if classes is None:
        return None
    _refuse_unless(type(classes) is dict, "of a known form")
    keys = [*parts[0]]
    names = {name for key in classes for name in (key, f"_{key}")}
    if {*keys} != names | {batches.APART_CLASSES}:  # there are marks
        return None
    for part, size in zip(parts, sizes, strict=True):
        if [*part] != keys or part[batches.APART_CLASSES] != classes:
            return None
        for key in classes:
            _refuse_unless_column(part[key], size)
            if part[key].dtype != parts[0][key].dtype:
                return None
    columns: Infos = {batches.APART_CLASSES: classes}
    for key in filter(names.__contains__, keys):
        each = [part[key] for part in parts]
        columns[key] = np.concatenate(each) if key in classes else np.ones(sum(sizes), np.bool_)
    return columns


def each_of(part: Infos, size: int) -> OwnInfos:
    """Each sub-environment's infos, from one shard."""
    own: OwnInfos = [[] for _ in range(size)]
    classes, forms = part.get(batches.APART_CLASSES, {}), part.get(batches.APART_FORMS, {})
    _refuse_unless(type(classes) is type(forms) is dict, "of a known form")
    if classes:
        for some, row in zip(own, _rows(part, classes, size), strict=True):
            some.append((row, {}))
    for place in sorted(key for key in part if type(key) is int and key >= 0):
        info, form = part[place], forms.get(place, {})
        _refuse_unless(type(info) is dict and place < 2 * size, "one mapping each")
        _refuse_unless(batches.are_forms(form), "of a known form")
        own[place % size].append((info, form))
    _add_marks(own, part, classes, size)
    return own


def _rows(part: Infos, classes: Infos, size: int) -> list[Infos]:
    columns = []
    for key, has_numpys in classes.items():
        _refuse_unless_column(part.get(key), size)
        columns.append(list(part[key]) if has_numpys else part[key].tolist())
    return [dict(zip(classes, row, strict=True)) for row in zip(*columns, strict=True)]


def _refuse_unless_column(value: Any, size: int) -> None:
    is_column = type(value) is np.ndarray and value.shape == (size,)
    _refuse_unless(is_column and value.dtype.kind in _NUMBERS, "one number each")


def _add_marks(own: OwnInfos, part: Infos, classes: Infos, size: int) -> None:
    for key in part:
        if type(key) is int:
            continue
        is_mask = type(key) is str and key[:1] == "_" and key[1:] in part
        _refuse_unless(is_mask or (type(key) is str and f"_{key}" in part), "one mapping each")
        if not is_mask and key not in classes:
            _refuse_unless_column(part[f"_{key}"], size)
            for index in np.flatnonzero(part[f"_{key}"]):
                *others, (info, form) = own[index] or [({}, {})]
                own[index] = [*others, ({**info, key: True}, form)]


def _refuse_unless(holds: bool, claim: str) -> None:
    if not holds:
        raise RemoteProtocolError(f"the worker's infos are not {claim}")
