"""A value without what cannot be sent: an inert description stands in the place of each such part.

Runs only after a value could not be encoded, so that one part of a step's infos does not lose the
rest of the step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from envhub_worker.protocol.codec.inert import RemoteObject, inert_copy, one_line, type_name
from envhub_worker.protocol.limits import WireLimits

_PLAIN = frozenset({bool, float, type(None)})
_SHORT = 64
"""Characters of a text, bits of an integer, that need no trial."""
_AROUND = 2
"""Containers: the message, and a description, which is one itself."""
_SPARE = 64
"""Items for what stands around the value in a message."""
Sendable = Callable[[object], bool]


def reduced(message: list[Any], sendable: Sendable, limits: WireLimits) -> list[Any]:
    """The fields of a message with descriptions in the place of what cannot be sent.

    A field that is a mapping or a tuple stays one.

    Args:
        sendable: Whether a value that is no container can be sent by itself.
    """
    walk = _Walk(sendable, limits)
    return [walk.members(field, 1) if walk.is_container(field) else field for field in message]


class _Walk:
    """Copies a value, in order, until as many items as may be sent are spent."""

    def __init__(self, sendable: Sendable, limits: WireLimits) -> None:
        self._sendable = sendable
        self._depth = limits.depth - _AROUND
        self._left = limits.items - _SPARE
        self._text_left = limits.header_bytes // 2

    def is_container(self, value: Any) -> bool:
        objects = isinstance(value, np.ndarray) and value.dtype.kind == "O"
        return objects or isinstance(value, (dict, list, tuple, set, frozenset))

    def value(self, value: Any, depth: int) -> Any:
        """What is sent of it."""
        kind = type(value)
        self._left -= 1
        if kind in _PLAIN or (kind is int and value.bit_length() < _SHORT):
            return value
        if kind is str or kind is bytes:
            short = len(value) <= _SHORT and value.isascii()
            if len(value) > self._text_left or not (short or self._sendable(value)):
                return inert_copy(value)
            self._text_left -= len(value)
            return value
        if not self.is_container(value):
            return value if self._sendable(value) else inert_copy(value)
        count = value.size if isinstance(value, np.ndarray) else len(value)
        if depth >= self._depth or count * (1 + isinstance(value, dict)) > self._left:
            return RemoteObject(type_name(kind), _counted(value, count))
        return self.members(value, depth)

    def members(self, value: Any, depth: int) -> Any:
        """A container of what is sent of its members."""
        if isinstance(value, dict):
            pairs = [(self.value(k, depth + 1), self.value(v, depth + 1)) for k, v in value.items()]
            return dict(pairs)
        if isinstance(value, np.ndarray):
            array = np.empty(value.size, object)
            for index, one in enumerate(value.ravel().tolist()):
                array[index] = self.value(one, depth + 1)
            return array.reshape(value.shape)
        if isinstance(value, (set, frozenset)):
            return value if self._sendable(value) else inert_copy(value)
        members = [self.value(one, depth + 1) for one in value]
        return tuple(members) if isinstance(value, tuple) else members


def _counted(value: Any, count: int) -> str:
    """Of a small one its text; of a large one, how large it is."""
    if count > _SHORT:
        return f"<{count} items>"
    try:
        return one_line(repr(value))
    except Exception as error:
        return f"<repr failed with {type(error).__name__}>"
