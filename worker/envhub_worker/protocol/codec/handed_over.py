"""What the caller hands over arrives exactly as it is, or is pickled as one piece.

The wire has forms for plain data. Where a value holds anything that these forms would change (the
class of a mapping, the order of an array in memory, a lone surrogate), or anything beyond their
limits, all of it is pickled. Only from client to worker: nothing that comes back is ever unpickled.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from envhub_worker.protocol.codec.arrays import MAX_DIMENSIONS, MAX_UNIT_COUNT
from envhub_worker.protocol.codec.encoder import PickledValue, Pickler
from envhub_worker.protocol.codec.inert import RemoteEnum, RemoteObject
from envhub_worker.protocol.limits import WireLimits

_DEPTH = 16
"""Containers in containers; a message's own count towards the wire's limit, too."""
_FEW = 64
"""Keys that are no text, and elements of a set: the receiver counts those of larger ones."""
_MOST_ARRAYS = 1024
"""Each may become a frame."""
_ATOMS = frozenset({type(None), bool, float, complex})
_SCALARS = frozenset(np.dtype(char).type for char in "?bBhHiIlLqQefdFDmM")
_ARRAYS = frozenset("?bBhHiIlLqQefdFDmMS")
"""Characters of dtypes whose bytes are all there is to them."""


def handed_over(value: object, pickler: Pickler, limits: WireLimits) -> object:
    """The value itself, if the wire carries exactly that, or else its pickle."""
    return value if _Judge(limits).holds(value, 0) else PickledValue(pickler(value))


class _Judge:
    """Says whether the wire's forms carry a value exactly, by the exact types of all that it holds.

    Whatever it does not know is not exact: it is pickled, and that is exact.
    """

    __slots__ = ("_arrays_left", "_bytes_left", "_left", "_limits")

    def __init__(self, limits: WireLimits) -> None:
        self._limits = limits
        self._left = limits.items // 2
        self._bytes_left = limits.header_bytes // 4
        self._arrays_left = _MOST_ARRAYS

    def holds(self, value: Any, depth: int) -> bool:
        kind = type(value)
        self._left -= 1
        if kind in _ATOMS:
            return True
        check = _CHECKS.get(kind)
        return (
            check is not None and depth < _DEPTH and self._left >= 0 and check(self, value, depth)
        )

    def all(self, values: Any, depth: int) -> bool:
        return all(self.holds(value, depth + 1) for value in values)

    def number(self, value: int, depth: int) -> bool:
        return value.bit_length() // 8 < self._limits.int_bytes

    def text(self, value: str, depth: int) -> bool:
        """A text: none that UTF-8 cannot carry."""
        if value.isascii():
            return self.bytes(value, depth)
        try:
            return self.bytes(value.encode(), depth)
        except UnicodeEncodeError:
            return False

    def bytes(self, value: Any, depth: int) -> bool:
        self._bytes_left -= len(value)
        return self._bytes_left >= 0 and len(value) <= self._limits.text_bytes

    def mapping(self, value: dict[Any, Any], depth: int) -> bool:
        plain = len(value) <= _FEW or set(map(type, value)) == {str}
        return plain and self.all(value, depth) and self.all(value.values(), depth)

    def elements(self, value: Any, depth: int) -> bool:
        """A set of a few."""
        return len(value) <= _FEW and self.all(value, depth)

    def bounds(self, value: Any, depth: int) -> bool:
        return self.all((value.start, value.stop, value.step), depth)

    def array(self, value: Any, depth: int) -> bool:
        """An array, as it lies in memory; strided ones are copied by pickle, too."""
        dtype = value.dtype
        self._arrays_left -= 1
        if self._arrays_left < 0 or value.ndim > MAX_DIMENSIONS:
            return False
        if value.flags.fnc or not dtype.isnative or not dtype.itemsize or dtype.metadata:
            return False
        if dtype.kind == "O":
            return self.all(value.ravel().tolist(), depth)
        return dtype.char in _ARRAYS and _is_unit(dtype)

    def scalar(self, value: Any, depth: int) -> bool:
        return _is_unit(value.dtype)


def _is_unit(dtype: np.dtype[Any]) -> bool:
    return dtype.kind not in "mM" or np.datetime_data(dtype)[1] <= MAX_UNIT_COUNT


def _always(judge: _Judge, value: Any, depth: int) -> bool:
    return True


_CHECKS: dict[type, Callable[[_Judge, Any, int], bool]] = {
    int: _Judge.number,
    bytes: _Judge.bytes,
    np.bytes_: _Judge.bytes,
    str: _Judge.text,
    np.str_: _Judge.text,
    list: _Judge.all,
    tuple: _Judge.all,
    dict: _Judge.mapping,
    set: _Judge.elements,
    frozenset: _Judge.elements,
    range: _Judge.bounds,
    slice: _Judge.bounds,
    np.ndarray: _Judge.array,
    RemoteObject: _always,
    RemoteEnum: _always,
    **dict.fromkeys(_SCALARS, _Judge.scalar),
}
