"""Members of a space whose sizes vary from step to step, as a few arrays.

The space says what members consist of, so that only their sizes vary: how many members a
``Sequence`` has, the rows of a ``Graph``'s nodes, which space of a ``OneOf`` a member is of. The
members of a batch are written together: the same part of all of them is one array.
"""

from __future__ import annotations

import math
from array import array as integers
from collections.abc import Callable, Sequence
from functools import partial
from itertools import accumulate, chain, islice, pairwise
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.spaces.graph import GraphInstance

from envhub_worker.protocol.codec.arrays import INLINE_BYTES, Array
from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.protocol.messages.forms import IrregularError
from envhub_worker.protocol.shared_memory.slabs import ACTION_DTYPES, DTYPE_CODES
from envhub_worker.protocol.shared_memory.words import INFO_BYTES, LINE
from envhub_worker.protocol.spaces.spaces import ARRAY_SPACES, OneOf

_STACKED = (*ARRAY_SPACES, spaces.Dict, spaces.Tuple)
"""Spaces whose members are stacked in a ``Sequence``; of others it has a tuple."""
_PYTHON_INTS = -1
_MISSING = -1
_MOST = INFO_BYTES
"""Items in one slot that have no number of their own. Each becomes an array, which takes a hundred
bytes and more, for a single byte in the slot."""
Copy = Callable[[], Any]
Items = tuple[Array, int]
"""An array, and the number of items that it is read as."""


class ArrayArea:
    """The part of a slot where arrays lie one after the other.

    Args:
        memory, start, room: The memory of all slots, the offset of this slot, and its size.
        used: Bytes of the slot that other arrays take.
        slot: As for ``StepColumns.read``.

    Attributes:
        used: Bytes of the slot that arrays take so far.
    """

    def __init__(self, memory: Any, start: int, room: int, used: int, slot: Any = None) -> None:
        self._memory, self._start, self._room, self._slot = memory, start, room, slot
        self.used = used
        self._items = 0

    def _next(self, nbytes: int, items: int) -> int:
        # all arrays are counted together: a space may name very many
        offset, self.used = self.used, self.used + -(-nbytes // LINE) * LINE
        self._items += items
        return offset if self.used <= self._room and self._items <= _MOST else -1

    def write(self, arrays: Sequence[Items]) -> None:
        """Write arrays. Raises ``IrregularError``: there is no room for all of them."""
        offsets = [self._next(array.nbytes, items) for array, items in arrays]
        if -1 in offsets:
            raise IrregularError
        for offset, (array, _) in zip(offsets, arrays, strict=True):
            np.ndarray(array.shape, array.dtype, self._memory, self._start + offset)[...] = array

    def read(self, dtype: np.dtype[Any], shape: tuple[int, ...], items: int) -> Array:
        """The next array, which belongs to the caller. Trust: its length and the number of
        ``items`` are input from the worker.
        Raises ``RemoteProtocolError``: the slot has no room for it.
        """
        offset = self._next(math.prod(shape) * dtype.itemsize, items)
        if offset < 0:
            raise RemoteProtocolError("the worker wrote more items than its slot has room for")
        if self._slot is not None and is_lent(shape, dtype):
            borrowed: Array = np.ndarray(shape, dtype, self._slot, offset)
            return borrowed
        array: Array = copier(self._memory, self._start + offset, shape, dtype)()
        return array


def copier(memory: Any, offset: int, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Copy:
    """Returns a function that copies an array. Trust: its bytes are input from the worker."""
    if dtype.kind == "b":  # a hostile byte of 2 would make a boolean that is neither
        return partial(np.ndarray(shape, np.uint8, memory, offset).astype, np.bool_)
    array: Array = np.ndarray(shape, dtype, memory, offset)
    return array.copy


def is_lent(shape: tuple[int, ...], dtype: np.dtype[Any]) -> bool:
    """Whether a caller who borrows a slot gets a view of such an array; else a copy."""
    return dtype.kind != "b" and dtype.itemsize * math.prod(shape) > INLINE_BYTES


class Written:
    """What members are written as: numbers (sizes, codes, integers), texts, and arrays."""

    def __init__(self) -> None:
        self.numbers: list[int] = []
        self.texts: list[str] = []
        self.arrays: list[Items] = []


class Received:
    """Reads what ``Written`` has, in the same order. Trust: input from the worker.
    ``arrays``: where the arrays lie.
    """

    def __init__(self, numbers: bytes, text: str, arrays: ArrayArea) -> None:
        self._numbers: list[int] = memoryview(numbers).cast("q").tolist()
        self._text, self._arrays = text, arrays
        self._next = self._letter = 0

    def numbers(self, count: int) -> list[int]:
        """The next numbers. A count that a worker sends allocates nothing before it is checked."""
        start, self._next = self._next, self._next + count
        if not 0 <= count <= len(self._numbers) - start:
            raise RemoteProtocolError("the worker wrote fewer sizes than its members have")
        return self._numbers[start : self._next]

    def array(self, code: int, shape: tuple[int, ...], items: int) -> Array:
        """The next array, of the dtype with this code."""
        if not 0 <= code < len(ACTION_DTYPES):
            raise RemoteProtocolError("the worker wrote an unknown dtype")
        return self._arrays.read(ACTION_DTYPES[code], shape, items)

    def texts(self, count: int) -> list[str]:
        """The next texts."""
        bounds = [*accumulate(_sizes(self.numbers(count)), initial=self._letter)]
        self._letter = bounds[-1]
        return [self._text[start:stop] for start, stop in pairwise(bounds)]

    def finish(self) -> None:
        """Raise ``RemoteProtocolError`` if anything is missing or left over."""
        if (self._next, self._letter) != (len(self._numbers), len(self._text)):
            raise RemoteProtocolError("the worker wrote other sizes than its members have")


Write = Callable[[Sequence[Any], Written], None]
"""Writes members. Raises any exception: they are not what the space says."""
Read = Callable[[int, Received], list[Any]]
"""Reads so many members."""


def _sizes(numbers: list[int]) -> list[int]:
    """The numbers, if they can be sizes. Trust: input from the worker."""
    if numbers and min(numbers) < 0:
        raise RemoteProtocolError("the worker wrote a negative size")
    return numbers


def varies(space: gym.Space[Any]) -> bool:
    """Whether members of the space have sizes of their own."""
    return isinstance(space, (spaces.Sequence, spaces.Graph)) or _is_one_of(space)


def members_of(space: Any, *, stacked: bool = False) -> tuple[Write, Read]:
    """Makes what writes and reads members of a space; ``stacked`` arrays have lengths of their own.

    Raises ``IrregularError``: its members may hold anything, or take no bytes, so that their number
    would have no bound.
    """
    if isinstance(space, ARRAY_SPACES):
        shape = tuple(space.shape or ())
        if stacked:
            return _arrays(shape)
        if shape:
            return _rows(shape)
        if isinstance(space, spaces.Discrete):
            return _write_integers, _read_integers
    elif isinstance(space, spaces.Text):
        return _write_texts, _read_texts
    elif isinstance(space, spaces.Dict) and space.spaces:
        parts = [members_of(part, stacked=stacked) for part in space.spaces.values()]
        return _fields(parts, {dict}, keys=list(space.spaces))
    elif isinstance(space, spaces.Tuple) and space.spaces:
        return _fields([members_of(part, stacked=stacked) for part in space.spaces], {tuple})
    elif isinstance(space, spaces.Sequence):
        if space.stack and isinstance(space.feature_space, _STACKED):
            return members_of(space.feature_space, stacked=True)
        return _sequences(*members_of(space.feature_space))
    elif isinstance(space, spaces.Graph):
        return _graphs(space)
    elif _is_one_of(space):
        return _choices([members_of(part) for part in space.spaces])
    raise IrregularError


def members_like(value: Any, count_part: Callable[[], None]) -> tuple[Write, Read]:
    """Makes what writes and reads members of the form of this one, or None in their place.
    ``count_part`` is called for each part of the form, and raises if they are too many.
    Raises ``IrregularError``: they may have other sizes, or it is of another class.
    """
    write, read = _form_of(value, count_part)

    def write_some(members: Sequence[Any], written: Written) -> None:
        written.numbers += [member is not None for member in members]
        write([member for member in members if member is not None], written)

    def read_some(count: int, received: Received) -> list[Any]:
        marks = received.numbers(count)
        if not {0, 1}.issuperset(marks):
            raise RemoteProtocolError("the worker wrote a mark that is neither 0 nor 1")
        members = iter(read(sum(marks), received))
        return [next(members) if mark else None for mark in marks]

    return write_some, read_some


def _form_of(value: Any, count_part: Callable[[], None]) -> tuple[Write, Read]:
    count_part()
    if type(value) is np.ndarray and value.ndim:
        return _rows(value.shape)
    if type(value) is int or isinstance(value, np.integer):
        return _write_integers, _read_integers
    if type(value) is str:
        return _write_texts, _read_texts
    if type(value) is dict and _classes([*value]) == {str}:
        parts = [_form_of(part, count_part) for part in value.values()]
        return _fields(parts, {dict}, keys=list(value))
    raise IrregularError


def _is_one_of(space: Any) -> bool:
    return OneOf is not None and isinstance(space, OneOf)


def _check(holds: bool) -> None:
    if not holds:
        raise IrregularError


def _classes(members: Sequence[Any]) -> set[type]:
    return {*map(type, members)}


def _joined(members: Sequence[Array], row: tuple[int, ...]) -> Array:
    """Arrays of a dtype, one after the other; raises if they have other rows."""
    dtype = members[0].dtype
    alone = len(members) == 1
    joined = members[0] if alone else np.concatenate(members, dtype=dtype, casting="no")
    _check(joined.shape[1:] == row)
    return joined


def _rows(shape: tuple[int, ...]) -> tuple[Write, Read]:
    """Arrays of a fixed shape."""
    first, *tail = shape
    row = tuple(tail)
    _check(math.prod(shape) > 0)

    def write(members: Sequence[Any], written: Written) -> None:
        if not members:
            return
        _check(_classes(members) == {np.ndarray} and {*map(len, members)} == {first})
        joined = _joined(members, row)
        written.numbers.append(DTYPE_CODES[joined.dtype])
        written.arrays.append((joined, len(members)))

    def read(count: int, received: Received) -> list[Any]:
        if not count:
            return []
        [code] = received.numbers(1)
        return list(received.array(code, (count, *shape), count))

    return write, read


def _arrays(row: tuple[int, ...], *, optional: bool = False) -> tuple[Write, Read]:
    """Arrays with lengths of their own; or None, if they are ``optional``."""
    least = _MISSING if optional else 0
    _check(math.prod(row) > 0)

    def write(members: Sequence[Any], written: Written) -> None:
        arrays = members
        lengths = [_MISSING if member is None else len(member) for member in members]
        if optional and _MISSING in lengths:
            arrays = [member for member in members if member is not None]
        code = 0
        if arrays:
            _check(_classes(arrays) == {np.ndarray})
            joined = _joined(arrays, row)
            code = DTYPE_CODES[joined.dtype]
            written.arrays.append((joined, 0))
        written.numbers.append(code)
        written.numbers += lengths

    def read(count: int, received: Received) -> list[Any]:
        code, *lengths = received.numbers(1 + count)
        fewest = min(lengths, default=0)
        if fewest < least:
            raise RemoteProtocolError("the worker wrote a negative size")
        rows = lengths if fewest >= 0 else [max(length, 0) for length in lengths]
        parts = [received.array(code, (sum(rows), *row), 0)]
        if count != 1:
            bounds = accumulate(rows, initial=0)
            parts = [parts[0][start:stop] for start, stop in pairwise(bounds)]
        if fewest < 0:
            return [None if n < 0 else part for n, part in zip(lengths, parts, strict=True)]
        return parts

    return write, read


def _write_integers(members: Sequence[Any], written: Written) -> None:
    """Integers of one class: Python's, or those of a dtype."""
    if members:
        [kind] = _classes(members)
        code = _PYTHON_INTS if kind is int else DTYPE_CODES[np.dtype(kind)]
        _check(kind is int or issubclass(kind, np.integer))
        written.numbers += [code, *map(int, members)]


def _read_integers(count: int, received: Received) -> list[Any]:
    if not count:
        return []
    [code] = received.numbers(1)
    numbers = received.numbers(count)
    if code == _PYTHON_INTS:
        return numbers
    if not 0 <= code < len(ACTION_DTYPES) or ACTION_DTYPES[code].kind not in "iu":
        raise RemoteProtocolError("the worker wrote an unknown dtype")
    return list(np.array(numbers, np.int64).astype(ACTION_DTYPES[code]))


def _write_texts(members: Sequence[Any], written: Written) -> None:
    _check(_classes(members) <= {str})
    written.numbers += map(len, members)
    written.texts += members


def _read_texts(count: int, received: Received) -> list[Any]:
    return received.texts(count)


def _fields(
    parts: list[tuple[Write, Read]], classes: set[type], make: Any = tuple, keys: Any = None
) -> tuple[Write, Read]:
    """Tuples, which ``make`` makes again, or mappings with their ``keys`` in this order."""

    def write(members: Sequence[Any], written: Written) -> None:
        _check(_classes(members) <= classes)
        if keys is not None:
            _check(all(list(member) == keys for member in members))
            members = [member.values() for member in members]
        columns = zip(*members, strict=True) if members else ((),) * len(parts)
        for (part, _), column in zip(parts, columns, strict=True):
            part(column, written)

    def read(count: int, received: Received) -> list[Any]:
        members = zip(*[part(count, received) for _, part in parts], strict=True)
        if keys is None:
            return list(map(make, members))
        return [dict(zip(keys, member, strict=True)) for member in members]

    return write, read


def _sequences(write_items: Write, read_items: Read) -> tuple[Write, Read]:
    def write(members: Sequence[Any], written: Written) -> None:
        _check(_classes(members) <= {tuple})
        written.numbers += map(len, members)
        write_items([*chain.from_iterable(members)], written)

    def read(count: int, received: Received) -> list[Any]:
        lengths = _sizes(received.numbers(count))
        items = iter(read_items(sum(lengths), received))
        return [tuple(islice(items, length)) for length in lengths]

    return write, read


def _graphs(space: spaces.Graph) -> tuple[Write, Read]:
    edge, links = space.edge_space, (2,)
    edges = tuple(edge.shape or ()) if isinstance(edge, ARRAY_SPACES) else ()
    _check(isinstance(space.node_space, ARRAY_SPACES))
    rows = (tuple(space.node_space.shape or ()), edges, links)
    parts = [_arrays(row, optional=True) for row in rows]
    return _fields(parts, {GraphInstance, tuple}, GraphInstance._make)


def _choices(parts: list[tuple[Write, Read]]) -> tuple[Write, Read]:
    """Pairs of the number of a space and a member of it."""

    def write(members: Sequence[Any], written: Written) -> None:
        _check(_classes(members) <= {tuple})
        numbers, chosen = zip(*members, strict=True) if members else ((), ())
        _write_integers(numbers, written)
        _check(not numbers or 0 <= min(numbers) <= max(numbers) < len(parts))
        members_by_part: list[list[Any]] = [[] for _ in parts]
        for number, member in zip(numbers, chosen, strict=True):
            members_by_part[number].append(member)
        for (part, _), of_part in zip(parts, members_by_part, strict=True):
            part(of_part, written)

    def read(count: int, received: Received) -> list[Any]:
        numbers = _read_integers(count, received)
        if numbers and not 0 <= min(numbers) <= max(numbers) < len(parts):
            raise RemoteProtocolError("the worker wrote a choice that the space does not have")
        counts = [0] * len(parts)
        for number in numbers:  # once: a hostile space may have very many parts
            counts[number] += 1
        chosen = [iter(part(counts[index], received)) for index, (_, part) in enumerate(parts)]
        return [(number, next(chosen[number])) for number in numbers]

    return write, read


def write_members(write: Write, count: int, batch: Any) -> tuple[bytes, str, list[Items]]:
    """A batch of ``count`` members as numbers, all texts as one text, and arrays.
    Raises ``IrregularError``: this is another batch.
    """
    written = Written()
    try:
        _check(type(batch) is tuple and len(batch) == count)
        write(batch, written)
        return integers("q", written.numbers).tobytes(), "".join(written.texts), written.arrays
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise IrregularError from error


def read_members(read: Read, count: int, received: Received) -> tuple[Any, ...]:
    """The batch of ``count`` members that ``write_members`` wrote. Trust: input from the worker."""
    members = tuple(read(count, received))
    received.finish()
    return members
