"""What recurs in messages: documents without arrays, such as calls and what a server is asked.

What the codec has made of a document is kept, when it is met again: a *form*. The key is the whole
document, or all that it depends on, so a form says exactly what the codec would say. Forms are
few and small: a peer that sends nothing twice gains nothing and costs nothing.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar, cast

from envhub_worker.protocol.codec.decoder import Decoder
from envhub_worker.protocol.codec.kinds import Buffer
from envhub_worker.protocol.limits import WireLimits

MAX_DOCUMENT_BYTES = 1024
_MAX_FORMS = 256
_MAX_ITEMS = 32
_MAX_TEXT = 256
_CONSTANTS = frozenset({int, bool, str, bytes, type(None)})
_BITS = struct.Struct("<d")
_TEXTS = frozenset({str, bytes})

K = TypeVar("K")
F = TypeVar("F")
T = TypeVar("T")


class Forms(Generic[K, F]):
    """Forms by key; one is made when its key is met for the second time.

    Until then there is no more of a key than its hash: most keys of a server come once, with the
    number of a jail or a time in them, and some are large. Two keys of one hash only get forms
    earlier, for a form is kept under the whole key.
    """

    def __init__(self) -> None:
        self._forms: dict[K, F] = {}
        self._once: set[int] = set()
        self.get = self._forms.get

    def met(self, key: K, make: Callable[[], F]) -> None:
        """Take note of a key that has no form, or none that holds.

        The codec has already made the message. So if ``make`` fails, for whatever reason, there is
        no form, and the codec makes the next message of this key too.
        """
        hashed = hash(key)
        if hashed not in self._once and key not in self._forms:
            if len(self._once) >= _MAX_FORMS:
                self._once.clear()
            self._once.add(hashed)
            return
        self._once.discard(hashed)
        try:
            form = make()
        except Exception:
            return
        if len(self._forms) >= _MAX_FORMS:
            self._forms.clear()
        self._forms[key] = form


class Outgoing(NamedTuple):
    """The frames of messages of one outline, and the limits that they were encoded for."""

    frames: list[Buffer]
    limits: WireLimits


class Incoming(Generic[T]):
    """What to make of a document that was decoded before.

    Args:
        document: All of it.
        make: Makes the message of its fields.
        limits: For which it was decoded, and holds.

    Raises:
        Exception: There is no form for it: it holds more than constants, tuples, lists and dicts.
    """

    __slots__ = ("_fields", "_make", "_message", "limits")

    def __init__(self, document: bytes, make: Callable[..., T], limits: WireLimits) -> None:
        self.limits = limits
        self._make = make
        value: Any = Decoder(b"", (), limits, None, None).value(document)
        fields = value[1:]
        self._fields = _maker(tuple(fields))
        self._message: T | None = make(*fields) if self._fields is None else None

    def message(self) -> T:
        """The message; what of it can be changed is fresh."""
        if self._fields is None:
            return cast("T", self._message)
        return self._make(*self._fields())


class _IrregularError(Exception):
    """There is no form for this."""


def _maker(value: Any) -> Callable[[], Any] | None:
    """Makes a fresh value like this one; None where it cannot be changed."""
    kind = type(value)
    if kind in _CONSTANTS or kind is float:
        return None
    if kind is dict and not set(map(type, value)) - {str}:
        named = [(key, item, _maker(item)) for key, item in value.items()]
        return lambda: {key: make() if make else item for key, item, make in named}
    if kind is not tuple and kind is not list:
        raise _IrregularError
    parts = [(item, _maker(item)) for item in value]
    if kind is list:
        return lambda: [make() if make else item for item, make in parts]
    if all(make is None for _, make in parts):
        return None
    return lambda: tuple([make() if make else item for item, make in parts])


def outline(values: list[Any]) -> tuple[Any, ...] | None:
    """All that the document of these values depends on.

    None if they hold anything but constants, and small tuples, lists and dicts.
    """
    try:
        return tuple([_outlined(value) for value in values])
    except (_IrregularError, RecursionError):  # deep or cyclic: the codec says what is wrong
        return None


def _outlined(value: Any) -> Any:
    kind = type(value)
    if kind is float:
        return kind, _BITS.pack(value)  # 0.0 is -0.0, and nan is not nan
    if kind in _CONSTANTS:
        if kind in _TEXTS and len(value) > _MAX_TEXT:
            raise _IrregularError
        return kind, value
    if kind is dict and len(value) <= _MAX_ITEMS:
        if set(map(type, value)) - {str}:
            raise _IrregularError
        return kind, tuple([(key, _outlined(item)) for key, item in value.items()])
    if (kind is tuple or kind is list) and len(value) <= _MAX_ITEMS:
        return kind, tuple([_outlined(item) for item in value])
    raise _IrregularError
