"""Values that the wire does not carry unchanged: pickled, named in an error, or described.

The caller's arguments arrive exactly as they are. The whole argument is pickled if it holds a value
that the wire's forms would change (the class of a mapping, the order of an array in memory, a lone
surrogate) or that is over their limits. Pickles go from client to worker only: the client unpickles
nothing.

The rest of this module runs only after a failure. An error tells the caller which part of a value
cannot be sent. In a runner's reply an inert description replaces each such part, so that one bad
info does not lose the rest of the step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from enum import Enum
from typing import Any

import numpy as np

from envhub_worker.protocol.codec.arrays import MAX_DIMENSIONS, MAX_UNIT_COUNT
from envhub_worker.protocol.codec.inert import (
    RemoteEnum,
    RemoteObject,
    inert_copy,
    one_line,
    type_name,
)
from envhub_worker.protocol.codec.wire import PickledValue, Pickler
from envhub_worker.protocol.errors import LocalProtocolError
from envhub_worker.protocol.limits import WireLimits

_DEPTH = 16
"""Containers in containers; a message's own count towards the wire's limit, too."""
_FEW = 64
"""Keys that are not text, or elements of a set. Above this the receiver counts their hashes."""
_MOST_ARRAYS = 1024
"""Most arrays in a value: each may become a frame."""
_ATOMS = frozenset({type(None), bool, float, complex})
_SCALARS = frozenset(np.dtype(char).type for char in "?bBhHiIlLqQefdFDmM")
_ARRAYS = frozenset("?bBhHiIlLqQefdFDmMS")
"""Characters of dtypes whose values are entirely in their bytes."""


def handed_over(
    fields: dict[str, object], handed: Sequence[str], pickler: Pickler, limits: WireLimits
) -> list[object]:
    """Returns the fields to send: those of the caller's own objects are pickled if the wire does
    not carry them exactly. Raises ``LocalProtocolError``: one cannot be pickled.
    """
    sent = fields.copy()
    for name in handed:
        try:
            if not _Judge(limits).holds(fields[name], 0):
                sent[name] = PickledValue(pickler(fields[name]))
        except Exception as error:  # whatever the caller's own classes raise
            text = unpicklable(name, fields[name], error, pickler)
            raise LocalProtocolError(text) from error
    return list(sent.values())


class _Judge:
    """Decides by the exact types of a value and its members whether the wire carries it exactly.

    A value of an unknown type counts as not exact, so it is pickled, which loses nothing.
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
        """Whether UTF-8 can carry a text."""
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
        """Whether a set is small and its elements are exact."""
        return len(value) <= _FEW and self.all(value, depth)

    def bounds(self, value: Any, depth: int) -> bool:
        return self.all((value.start, value.stop, value.step), depth)

    def array(self, value: Any, depth: int) -> bool:
        """Whether an array keeps its layout in memory. Pickle copies strided arrays, too."""
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
    **dict.fromkeys((RemoteObject, RemoteEnum), lambda judge, value, depth: True),
    **dict.fromkeys(_SCALARS, _Judge.scalar),
}

Path = tuple[object, ...]
Send = Callable[[object], object]
"""Raises for a value that is no container and cannot be sent by itself."""
_ATTEMPTS = 2000
"""Values that are pickled to find the one that cannot be."""


def explain(
    value: object, error: Exception, limits: WireLimits, send: Send, names: Sequence[str] = ()
) -> str:
    """Says what cannot be sent, and where in the value it is."""
    misfit = _Search(limits, send).first(value, (), ())
    if misfit is None:
        return f"The value cannot be sent: {error}"
    path, reason = misfit
    if path and names:
        path = (names[path[0]], *path[1:])  # type: ignore[call-overload]
    return f"{_path_text(path)} cannot be sent: {reason}."


def unpicklable(name: str, value: object, error: Exception, pickler: Pickler) -> str:
    """Says which part of an argument cannot be pickled, and what to do."""
    text, culprit, error = _culprit(name, value, error, pickler, {id(value)})
    reason = one_line(f"{type(error).__name__}: {error}", 500)
    return (
        f"{one_line(text)} cannot be sent: a {type_name(type(culprit))} cannot be pickled "
        f"({reason}). Pass plain data, or a function that makes the object there."
    )


def _culprit(
    text: str, value: object, error: Exception, pickler: Pickler, seen: set[int]
) -> tuple[str, object, Exception]:
    """Returns the innermost value that cannot be pickled: its path, the value and the error."""
    for step, child in _members(value):
        if id(child) in seen or len(seen) > _ATTEMPTS:
            continue
        seen.add(id(child))
        try:
            pickler(child)
        except Exception as inner:
            return _culprit(text + step, child, inner, pickler, seen)
    return text, value, error


def _members(value: object) -> Iterator[tuple[str, object]]:
    """The elements and attributes of a value, each after the text of the step to it."""
    for step, child in _children(value) or ():
        yield f"[{_step_text(step)}]", child
    attributes = getattr(value, "__dict__", None)
    if type(attributes) is dict:
        for name, child in attributes.items():
            yield f".{name}", child


class _Search:
    """Walks a value until it meets the offender, or has met as many values as may be sent."""

    def __init__(self, limits: WireLimits, send: Send) -> None:
        self.limits, self._send = limits, send
        self._left = limits.items

    def first(self, value: object, path: Path, above: tuple[int, ...]) -> tuple[Path, str] | None:
        """Returns path and reason of the first value that is cyclic, too deep, or refused."""
        children = _children(value)
        if children is None:
            reason = _refusal(value, self._send)
            return None if reason is None else (path, reason)
        if id(value) in above:
            return path, "it contains itself"
        if len(above) == self.limits.depth:
            return path, f"it is nested deeper than {self.limits.depth} containers"
        for step, child in children:
            self._left -= 1
            if self._left < 0:
                return None
            misfit = self.first(child, (*path, step), (*above, id(value)))
            if misfit is not None:
                return misfit
        return None


def _refusal(value: object, send: Send) -> str | None:
    try:
        send(value)
    except Exception as error:
        return str(error).rstrip(".") or type(error).__name__
    return None


def _children(value: object) -> list[tuple[object, object]] | None:
    """Returns steps and elements of a container, None for a leaf."""
    if isinstance(value, dict):
        keys = [(key, key) for key in value if isinstance(key, tuple | frozenset | Enum)]
        return [*keys, *value.items()]
    if isinstance(value, list | tuple | set | frozenset):
        return list(enumerate(value))
    if isinstance(value, np.ndarray) and value.dtype.kind == "O":
        return list(enumerate(value.ravel().tolist()))
    return None


def _path_text(path: tuple[object, ...]) -> str:
    """Writes ``("info", "a", 3)`` as ``info["a"][3]``."""
    if not path:
        return "The value"
    first, *rest = path
    named = isinstance(first, str) and first.isidentifier()
    steps = [str(first)] if named else [f"value[{_step_text(first)}]"]
    return one_line("".join([*steps, *(f"[{_step_text(step)}]" for step in rest)]))


def _step_text(step: object) -> str:
    return inert_copy(step).text


_PLAIN = frozenset({bool, float, type(None)})
_SHORT = 64
"""Texts of so few characters, and integers of so few bits, can always be sent."""
_AROUND = 2
"""Containers that the message itself and a ``RemoteObject`` in it add to the depth."""
_SPARE = 64
"""Items that are kept free for the rest of the message."""


def reduced(message: list[Any], send: Send, limits: WireLimits) -> list[Any]:
    """Returns the fields of a message with a description in place of each part that cannot be sent.

    A field that is a mapping or a tuple stays one.
    """
    walk = _Walk(send, limits)
    return [walk.members(field, 1) if _is_container(field) else field for field in message]


def _is_container(value: Any) -> bool:
    objects = isinstance(value, np.ndarray) and value.dtype.kind == "O"
    return objects or isinstance(value, (dict, list, tuple, set, frozenset))


class _Walk:
    """Copies a value with descriptions in place of members that cannot or may not be sent."""

    def __init__(self, send: Send, limits: WireLimits) -> None:
        self._send = send
        self._depth = limits.depth - _AROUND
        self._left = limits.items - _SPARE
        self._text_left = limits.header_bytes // 2

    def value(self, value: Any, depth: int) -> Any:
        """Returns the value that is sent in place of ``value``."""
        kind = type(value)
        self._left -= 1
        if kind in _PLAIN or (kind is int and value.bit_length() < _SHORT):
            return value
        if kind is str or kind is bytes:
            short = len(value) <= _SHORT and value.isascii()
            if len(value) > self._text_left or not (short or self.is_sent(value)):
                return inert_copy(value)
            self._text_left -= len(value)
            return value
        if not _is_container(value):
            return value if self.is_sent(value) else inert_copy(value)
        count = value.size if isinstance(value, np.ndarray) else len(value)
        if depth >= self._depth or count * (1 + isinstance(value, dict)) > self._left:
            large = RemoteObject(type_name(kind), f"<{count} items>")
            return large if count > _SHORT else inert_copy(value)
        return self.members(value, depth)

    def is_sent(self, value: object) -> bool:
        """Whether a value can be sent unchanged. Ignores the error: even its text may raise."""
        try:
            self._send(value)
        except Exception:
            return False
        return True

    def members(self, value: Any, depth: int) -> Any:
        """Returns a container with each member replaced by the result of ``value``."""
        if isinstance(value, dict):
            pairs = [(self.value(k, depth + 1), self.value(v, depth + 1)) for k, v in value.items()]
            return dict(pairs)
        if isinstance(value, np.ndarray):
            array = np.empty(value.size, object)
            for index, member in enumerate(value.ravel().tolist()):
                array[index] = self.value(member, depth + 1)
            return array.reshape(value.shape)
        if isinstance(value, (set, frozenset)):
            return value if self.is_sent(value) else inert_copy(value)
        members = [self.value(member, depth + 1) for member in value]
        return tuple(members) if isinstance(value, tuple) else members
