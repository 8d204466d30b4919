"""Cutting batches of actions into slices for shards, and joining the slices of their results.

The dispatch is on the *single* space: a batched ``Tuple`` may be a batch of tuples or, for a
custom space, a tuple of members. Followed: ``gymnasium.vector.utils.iterate`` and ``concatenate``.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.spaces.graph import GraphInstance
from gymnasium.vector.utils import iterate

from envhub_worker.protocol.codec.inert import RemoteObject, inert_copy, one_line
from envhub_worker.protocol.errors import FAULTS, MessageTooLargeError
from envhub_worker.protocol.spaces.spaces import ARRAY_SPACES, OneOf

Bounds = Sequence[tuple[int, int]]
_SHOWN, _KEYS = 100, 20


def even_bounds(count: int, parts: int) -> list[tuple[int, int]]:
    """Divides ``count`` members among ``parts`` shards evenly: ``[(start, stop), ...]``."""
    size, larger = divmod(count, parts)
    starts = [index * size + min(index, larger) for index in range(parts + 1)]
    return list(itertools.pairwise(starts))


def is_batch(batched: gym.Space[Any], single: gym.Space[Any], count: int) -> bool:
    """Whether a vector environment's space has the form of ``count`` members of the single space.

    Compares arrays in mappings and tuples of the same keys; other spaces count as True. Allocates
    nothing, since both spaces may come from a worker.
    """
    if isinstance(single, ARRAY_SPACES):
        shape = (count, *(single.shape or ()))
        return isinstance(batched, ARRAY_SPACES) and batched.shape == shape
    if isinstance(single, spaces.Dict):
        return (
            isinstance(batched, spaces.Dict)
            and batched.spaces.keys() == single.spaces.keys()
            and all(is_batch(batched[key], sub, count) for key, sub in single.spaces.items())
        )
    if isinstance(single, spaces.Tuple):
        return (
            isinstance(batched, spaces.Tuple)
            and len(batched.spaces) == len(single.spaces)
            and all(
                is_batch(whole, sub, count)
                for whole, sub in zip(batched.spaces, single.spaces, strict=True)
            )
        )
    return True


def _mapped(leaf: Callable[..., Any], space: gym.Space[Any], *values: Any) -> Any:
    """Rebuild the nesting of ``space`` with ``leaf(space, *parts)`` for each space in it."""
    if isinstance(space, spaces.Dict):
        items = space.spaces.items()
        return {key: _mapped(leaf, sub, *(value[key] for value in values)) for key, sub in items}
    if isinstance(space, spaces.Tuple):
        return tuple(_mapped(leaf, *parts) for parts in zip(space.spaces, *values, strict=True))
    return leaf(space, *values)


def _item(index: Any, space: gym.Space[Any], batch: Any) -> Any:
    return batch[index]


def split(space: gym.Space[Any], batch: Any, bounds: Bounds) -> list[Any]:
    """Cuts a batch into slices. Arrays are views."""
    if isinstance(space, ARRAY_SPACES):  # in each step of several workers
        return [batch[start:stop] for start, stop in bounds]
    return [_mapped(partial(_item, slice(*window)), space, batch) for window in bounds]


def only(space: gym.Space[Any], batch: Any) -> Any:
    """The member of a batch of one. Mappings have the space's order, which a batch may sort."""
    return _mapped(partial(_item, 0), space, batch)


def members(
    space: gym.Space[Any], batched: gym.Space[Any], batch: Any, count: int
) -> Iterable[Any]:
    """Iterates like Gymnasium's ``iterate``, which finds nothing in an empty mapping or tuple."""
    if _has_empty(space):
        return (_mapped(partial(_item, index), space, batch) for index in range(count))
    return iterate(batched, batch)


def _has_empty(space: gym.Space[Any]) -> bool:
    if isinstance(space, spaces.Dict):
        return not space.spaces or any(map(_has_empty, space.spaces.values()))
    return isinstance(space, spaces.Tuple) and (
        not space.spaces or any(map(_has_empty, space.spaces))
    )


def reordered(space: gym.Space[Any], batch: Any, order: Sequence[int]) -> Any:
    """Returns a batch's members in another order; lists stay lists and tuples stay tuples."""
    return _mapped(partial(_reordered, order), space, batch)


def _reordered(order: Sequence[int], space: gym.Space[Any], batch: Any) -> Any:
    if isinstance(batch, np.ndarray):
        return batch[np.asarray(order)]
    return type(batch)(batch[index] for index in order)


def join(space: gym.Space[Any], parts: Sequence[Any]) -> Any:
    """Joins the shards' slices, in order, into one batch."""
    if isinstance(space, ARRAY_SPACES):  # in each step of several workers
        return np.concatenate(parts)
    return _mapped(_joined, space, *parts)


def _joined(space: gym.Space[Any], *parts: Any) -> Any:
    if isinstance(space, ARRAY_SPACES):
        return np.concatenate(parts)
    return tuple(itertools.chain.from_iterable(parts))


def conforms(space: gym.Space[Any], batch: Any, count: int) -> bool:
    """Whether a batch of ``count`` members has the structure, shapes and dtypes of the space.

    Values are not checked: many environments leave their own bounds.
    """
    if isinstance(space, ARRAY_SPACES):
        shape = (count, *(space.shape or ()))
        return type(batch) is np.ndarray and batch.dtype == space.dtype and batch.shape == shape
    if isinstance(space, spaces.Dict):
        if type(batch) is not dict or batch.keys() != space.spaces.keys():
            return False
        return all(conforms(sub, batch[key], count) for key, sub in space.spaces.items())
    if type(batch) is not tuple:
        return False
    if not isinstance(space, spaces.Tuple):
        return len(batch) == count
    if len(batch) != len(space.spaces):
        return False
    return all(conforms(sub, item, count) for sub, item in zip(space.spaces, batch, strict=True))


APART_SCALARS = -1
"""The key of the result of ``integers``, in the unjoined infos of a single sub-environment."""


APART_REWARD = -2
"""Likewise of a tuple with its reward, if that is not a number: a dict of agents, for example."""


APART_FORMS = -3
"""Likewise of ``forms_of`` each info that has forms, under the info's place."""


APART_CLASSES = -4
"""The key, in infos that are columns, of whether each has numpy's values, not Python's."""


def reward_misfit(reward: Any, index: int, shape: tuple[int, ...] = ()) -> str:
    """The error text for a reward that no vector environment can hold."""
    needed = f"numbers of shape {shape}, as its reward_space says" if shape else "one number each"
    return (
        f"step of sub-environment {index} returned {shown(reward)} as reward. A vector environment "
        f"needs {needed}: return float(reward), or use SandboxEnv, which passes on any"
    )


def shown(value: Any) -> str:
    """The dtype and shape of an array, the keys of a dict, or the class and how its repr begins."""
    if isinstance(value, gym.Space):
        return f"the space {one_line(str(value), _SHOWN)}"
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        kind = "" if isinstance(value, (np.ndarray, np.generic)) else f"{type(value).__name__} "
        return one_line(f"{kind}{value.dtype} {tuple(value.shape)}", _SHOWN)
    if value is None:
        return "None"
    if type(value) is dict and not value:
        return "an empty dict"
    if type(value) is dict:
        return f"dict with {one_line(', '.join(map(repr, itertools.islice(value, _KEYS))), _SHOWN)}"
    inert = value if isinstance(value, RemoteObject) else inert_copy(value)
    return f"{inert.type_name} {one_line(inert.text, _SHOWN)}"


def integers(space: gym.Space[Any], member: Any) -> list[bool]:
    """Whether each discrete part of a member of the space is a Python ``int``."""
    if isinstance(space, spaces.Discrete):
        return [isinstance(member, int)]
    if isinstance(space, spaces.Dict):
        members = [integers(sub, member[key]) for key, sub in space.spaces.items()]
    elif isinstance(space, spaces.Tuple):
        members = [integers(sub, member[index]) for index, sub in enumerate(space.spaces)]
    else:
        return []
    return list(itertools.chain.from_iterable(members))


def as_returned(space: gym.Space[Any], member: Any, which: Iterator[bool]) -> Any:
    """A member of a batch as its environment returned it. The inverse of ``integers``: the discrete
    parts that ``which`` marks are Python ``int``. Mappings have the space's order, which a batch of
    them may sort, and a Box without dimensions has arrays.
    """

    def restored(space: gym.Space[Any], member: Any) -> Any:
        if isinstance(space, spaces.Box):
            return np.asarray(member)
        return int(member) if isinstance(space, spaces.Discrete) and next(which, False) else member

    return _mapped(restored, space, member)


def own_infos(pairs: Pairs, count: int, forms: Sequence[Forms] = ()) -> dict[Any, Any]:
    """The infos of a shard's ``count`` sub-environments, which are not joined: under its index, or
    plus ``count`` if it has an info already, because its episode ended in the same step.
    """
    infos: dict[Any, Any] = {}
    own_forms: Forms = {}
    for (index, info), form in zip(pairs, forms or itertools.repeat(_NO_FORMS), strict=False):
        place = index + count if index in infos else index
        infos[place] = info
        if form:
            own_forms[place] = form
    if own_forms:
        infos[APART_FORMS] = own_forms
    return infos


def flat_infos(pairs: Pairs, count: int) -> dict[Any, Any] | None:
    """A shard's infos as columns, with their classes, if these lose nothing. Otherwise None."""
    if [index for index, _ in pairs] != list(range(count)):
        return None
    classes = _classes_of([info for _, info in pairs])
    try:
        return classes and {**join_pairs(pairs, count), APART_CLASSES: classes}
    except FAULTS:  # an integer beyond 64 bit
        return None


def _classes_of(infos: Sequence[Any]) -> dict[Any, Any] | None:
    """For each key whether its values are numpy's, not Python's, or the same of nested infos. None
    if infos have other keys, or in another order, or if a key's values make no such column.
    """
    first = infos[0]
    if any(list(info) != list(first) or {*map(type, info)} != {str} for info in infos):
        return None
    if "final_obs" in first or any(f"_{key}" in first for key in first):
        return None  # a column of objects, or a key that is another's mask
    classes = {key: _class_of([info[key] for info in infos]) for key in first}
    return None if None in classes.values() else classes


def _class_of(values: Sequence[Any]) -> Any:
    kind, first = type(values[0]), values[0]
    if {*map(type, values)} != {kind}:
        return None
    if kind is dict:
        return _classes_of(values)
    if kind is not np.ndarray:
        return issubclass(kind, np.generic) if kind in _NUMBERS else None
    is_plain = first.ndim and first.dtype.isnative and first.dtype.type in _NUMBERS | {np.bool_}
    is_alike = {(value.dtype, value.shape) for value in values} == {(first.dtype, first.shape)}
    return True if is_plain and is_alike else None


def _bytes(*infos: dict[Any, Any]) -> int:
    """Total size of the arrays in infos."""
    values = [value for info in infos for value in info.values()]
    nested = _bytes(*(value for value in values if isinstance(value, dict))) if values else 0
    return nested + sum(value.nbytes for value in values if isinstance(value, np.ndarray))


Forms = dict[Any, Any]
"""What infos lose on the wire and joining them depends on: see ``forms_of``."""
Pairs = Sequence[tuple[int, dict[Any, Any]]]
"""Infos with the index of their sub-environment, in the order in which they came."""
Column = Callable[[Any, int], Any]
_SCALARS = frozenset({int, float, bool})
_NUMBERS = _SCALARS | {np.dtype(char).type for char in "bBhHiIlLqQefd"}
"""Classes whose values lose nothing in an array of their dtype, but which of them they had."""
_NO_FORMS: Forms = {}
_NO_FORM: tuple[str, bool, Forms, Forms] = ("", False, _NO_FORMS, _NO_FORMS)
_SAME = _NUMBERS | {str, bytes, type(None), list, tuple, dict, np.ndarray, np.bool_}
"""Values of these classes are joined alike on both sides."""


def forms_of(info: dict[Any, Any]) -> Forms:
    """For each entry whose class the wire changes: the name of its mask, whether its column has
    dtype object, the same for nested entries, and its ``_casts``. An ``IntEnum``'s member arrives
    as its number.
    """
    forms: Forms = {}
    for key, value in info.items():
        inner = forms_of(value) if isinstance(value, dict) else _NO_FORMS
        is_same = type(value) in _SAME
        casts = _casts(value) if type(value) is np.ndarray or not is_same else _NO_FORMS
        if inner or casts or type(key) is not str or not is_same:
            is_array = isinstance(value, (dict, np.ndarray)) or is_scalar(type(value))
            forms[key] = (f"_{key}", not is_array, inner, casts)
    return forms


_CASTS = {"i": int, "f": float, "b": bool}
"""By the kind of an array's dtype, what it makes of other objects (``Decimal``)."""
_CONVERTERS = ("__int__", "__float__", "__bool__", "__len__")


def _casts(value: Any) -> Forms:
    """What a column makes of an object that arrives as its text, by the kind of the column's dtype;
    of an array of structures, which arrive as tuples, under "V" an array of a blank one.
    """
    kind = type(value)
    if isinstance(value, np.ndarray):
        return {"V": np.zeros(1, value.dtype)} if value.dtype.names else {}
    if hasattr(kind, "__array__") or not any(hasattr(kind, name) for name in _CONVERTERS):
        return {}
    casts: Forms = {}
    for name, number in _CASTS.items():
        cell: Any = np.zeros(1, number)
        with contextlib.suppress(Exception):  # the object's own code
            cell[0] = value
            casts[name] = cell.item()
    return casts


def _are_casts(casts: Any) -> bool:
    return type(casts) is dict and all(
        type(cast) is _CASTS[kind]
        if kind in _CASTS
        else kind == "V" and type(cast) is np.ndarray and cast.shape == (1,)
        for kind, cast in casts.items()
    )


def _cast(casts: Forms, value: Any, column: Any) -> Any:
    """What to write into a column in place of a value."""
    if isinstance(value, np.ndarray):
        return value if value.ndim else value[()]  # the tuple of a structure
    kind = getattr(getattr(column, "dtype", None), "kind", "O")
    return casts.get({"u": "i"}.get(kind, kind), value)


def are_forms(forms: Any) -> bool:
    """Whether a value has the structure of ``forms_of``'s result. Trust: it may be anything."""
    return type(forms) is dict and all(
        type(form) is tuple
        and list(map(type, form)) == [str, bool, dict, dict]
        and are_forms(form[2])
        and _are_casts(form[3])
        for form in forms.values()
    )


def join_pairs(
    pairs: Pairs, count: int, max_bytes: int | None = None, forms: Sequence[Forms] = ()
) -> dict[Any, Any]:
    """Joins the infos of ``count`` sub-environments like ``VectorEnv._add_info``.

    Args:
        pairs: Each sub-environment's index and its infos.
        count: Number of sub-environments.
        max_bytes: How much larger than the infos their columns may be: a few bytes make a large
            column.
        forms: For each of the pairs, the result of ``forms_of`` in the process that sent it.

    Raises:
        Exception: Whatever Gymnasium would raise, with the key in front.
        MessageTooLargeError: The columns would take more than ``max_bytes``.
    """
    left, own_bytes = max_bytes, 0

    def column(value: Any, count: int) -> Any:
        nonlocal left, own_bytes
        if left is not None:
            left -= count * max(np.dtype(np.float64).itemsize, getattr(value, "nbytes", 0))
            if left < 0 and not own_bytes:  # counted once, and seldom
                own_bytes = 1 + _bytes(*(info for _, info in pairs))
                left += own_bytes
            if left < 0:
                raise MessageTooLargeError(
                    f"joined infos take more than {max_bytes} bytes beyond their own"
                )
        return blank_column(value, count)

    infos: dict[Any, Any] = {}
    make = blank_column if max_bytes is None else column
    for (index, info), own in zip(pairs, forms or itertools.repeat(_NO_FORMS), strict=False):
        add_info(infos, info, index, count, make, own)
    return infos


def add_info(
    infos: dict[Any, Any],
    info: dict[Any, Any],
    index: int,
    count: int,
    column: Column,
    forms: Forms = _NO_FORMS,
) -> dict[Any, Any]:
    """Does what ``VectorEnv._add_info`` does, without its allocations."""
    for key, value in info.items():
        array: Any
        mask_key, is_object, inner, casts = forms.get(key, _NO_FORM) if forms else _NO_FORM
        try:
            if key == "final_obs":
                array = infos[key] if key in infos else column(None, count)
                array[index] = value
            elif isinstance(value, dict) and not is_object:
                array = add_info(infos.get(key, {}), value, index, count, column, inner)
            else:
                first = None if is_object else value
                array = infos.get(key)
                if key not in infos:
                    array = column(first, count)
                    if "V" in casts:
                        array.fill(casts["V"][0])
                array[index] = _cast(casts, value, array) if casts else value
            mask_key = mask_key or f"_{key}"
            mask = infos.get(mask_key)
            if mask is None:
                mask = column(True, count)
            mask[index] = True
            infos[key], infos[mask_key] = array, mask
        except FAULTS as error:
            error.args = (f"info {key!r} of sub-environment {index}: {error}",)
            raise
    return infos


def blank_column(value: Any, count: int) -> Any:
    """Makes the array for a new key; this first value determines its dtype."""
    kind = type(value)
    if is_scalar(kind):
        return np.zeros(count, dtype=kind)
    if isinstance(value, np.ndarray):
        return np.zeros((count, *value.shape), dtype=value.dtype)
    return np.full(count, None, dtype=object)


def is_scalar(kind: type) -> bool:
    """Whether values of this class are kept in an array of their dtype."""
    return kind in _SCALARS or issubclass(kind, np.number)


def restores(space: gym.Space[Any]) -> bool:
    """Whether members of the space lose their class on the wire (``GraphInstance``)."""
    if type(space) in ARRAY_SPACES:
        return False
    if isinstance(space, spaces.Graph):
        return True
    if isinstance(space, spaces.Dict):
        return any(map(restores, space.spaces.values()))
    inner = getattr(space, "spaces", None) or getattr(space, "feature_space", None)
    if isinstance(inner, tuple):
        return any(map(restores, inner))
    return isinstance(inner, gym.Space) and restores(inner)


def restore_batch(space: gym.Space[Any], batch: Any) -> Any:
    """Like ``restore``, for the members of a batch, however many."""
    return restore(space, batch, _restored_members)


def _restored_members(space: Any, batch: Any) -> Any:
    return tuple(restore(space, member) for member in batch) if isinstance(batch, tuple) else batch


def restore(space: Any, member: Any, leaf: Callable[[Any, Any], Any] | None = None) -> Any:
    """Gives a member the class that Gymnasium gives it, by ``leaf`` in mappings and tuples. A
    misfit stays as it is.
    """
    if isinstance(space, spaces.Dict) and isinstance(member, dict):
        parts = space.spaces
        return {
            key: restore(parts[key], item, leaf) if key in parts else item
            for key, item in member.items()
        }
    if isinstance(space, spaces.Tuple) and isinstance(member, tuple):
        if len(member) == len(space.spaces):
            return tuple(map(partial(restore, leaf=leaf), space.spaces, member))
        return member
    return (leaf or _restored)(space, member)


def _restored(space: Any, member: Any) -> Any:
    if not isinstance(member, tuple):
        return member
    if isinstance(space, spaces.Graph) and len(member) == len(GraphInstance._fields):
        return GraphInstance(*member)
    if OneOf is not None and isinstance(space, OneOf):
        try:
            index, chosen = member
            return (index, restore(space.spaces[index], chosen))
        except FAULTS:
            return member
    if isinstance(space, spaces.Sequence):
        if space.stack:
            return restore_batch(space.feature_space, member)
        return tuple(restore(space.feature_space, item) for item in member)
    return member
