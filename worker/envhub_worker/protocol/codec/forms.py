"""What recurs in messages: documents that differ in nothing but their arrays' bytes.

In a run of steps nearly every message is of that kind. So what the codec has made of a document
is kept, when it is met again: a *form*, into which only the arrays are put. The key is the whole
document, or all that it depends on, so a form says exactly what the codec would say. Forms are
few and small: a peer that sends nothing twice gains nothing and costs nothing. numpy is imported
by the first array, for a server has none.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

from envhub_worker.protocol.codec.decoder import Decoder
from envhub_worker.protocol.codec.frames import check_outgoing_frames, split_frames
from envhub_worker.protocol.codec.kinds import DOCUMENT_BYTES, Buffer
from envhub_worker.protocol.errors import MessageTooLargeError
from envhub_worker.protocol.limits import WireLimits

if TYPE_CHECKING:
    import numpy as np

    from envhub_worker.protocol.codec.arrays import Array, ArrayReader

MAX_DOCUMENT_BYTES = 1024
_MAX_FORMS = 256
_MAX_ITEMS = 32
_MAX_TEXT = 256
_CONSTANTS = frozenset({int, bool, str, bytes, type(None)})
_BITS = struct.Struct("<d")
_TEXTS = frozenset({str, bytes})
_NUMBERS = frozenset("biufc")

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


class Outgoing:
    """How to pack messages of one outline.

    Args:
        frames: What the codec has made of one of them.
        arrays: That one's arrays.
        limits: For which it was encoded, and holds.
    """

    __slots__ = ("_head", "_in_header", "limits")

    def __init__(self, frames: list[Buffer], arrays: list[Array], limits: WireLimits) -> None:
        document, tail, buffers = split_frames(frames, limits)
        self.limits = limits
        self._head = DOCUMENT_BYTES.pack(len(document)) + document
        longest = len(self._head) + len(tail)
        self._in_header = (
            not buffers
            and longest <= min(limits.header_bytes, limits.message_bytes)
            and all(array.dtype.isnative for array in arrays)
        )

    def frames(self, arrays: list[Array]) -> list[Buffer]:
        """What ``encode`` would return.

        Raises:
            LocalProtocolError: More than the receiver accepts.
        """
        if self._in_header:
            return [b"".join([self._head, *[array.tobytes() for array in arrays]])]
        from envhub_worker.protocol.codec.arrays import ArrayWriter

        writer = ArrayWriter()
        for array in arrays:
            writer.add(array)
        frames: list[Buffer] = [b"".join((self._head, *writer.tail)), *writer.frames]
        check_outgoing_frames(frames, self.limits)
        return frames


class Incoming(Generic[T]):
    """What to make of a document that was decoded before.

    Args:
        document: All of it.
        make: Makes the message of its fields.
        limits: For which it was decoded, and holds.

    Raises:
        Exception: There is no form for it: it holds more than constants, numeric arrays, tuples,
            lists and dicts.
    """

    __slots__ = (
        *("_descriptors", "_fields", "_make", "_message", "_own", "_tail_bytes", "_views"),
        "limits",
    )

    def __init__(self, document: bytes, make: Callable[..., T], limits: WireLimits) -> None:
        self.limits = limits
        self._make = make
        self._message: T | None = None
        self._descriptors: list[bytes] = []
        self._views: list[tuple[np.dtype[Any], tuple[int, ...], slice]] = []
        self._tail_bytes: int | None = 0
        places = _Places(self._descriptors)
        value: Any = Decoder(b"", (), limits, None, None, arrays=places).value(document)
        fields = value[1:]
        self._fields = _maker(tuple(fields))
        self._lay_out()
        if self._fields is None:
            self._message = make(*fields)

    def _lay_out(self) -> None:
        """Where each array lies, if all lie in the tail of the header and hold numbers."""
        start = 0
        if self._descriptors:
            from envhub_worker.protocol.codec.arrays import own, parse_descriptor

            self._own = own
        for descriptor in self._descriptors:
            dtype, shape, nbytes, own_frame = parse_descriptor(descriptor)
            if own_frame or dtype.kind not in _NUMBERS:
                self._tail_bytes = None
                self._views.clear()
                return
            self._views.append((dtype, shape, slice(start, start + nbytes)))
            start += nbytes
        self._tail_bytes = start

    def message(self, tail: Buffer, buffers: list[Buffer]) -> T:
        """The message with these arrays. Trust: as ``decode``.

        Raises:
            RemoteProtocolError: Their bytes are not what the document says.
        """
        if len(tail) == self._tail_bytes and not buffers:
            arrays = [self._own(tail[where], dtype, shape) for dtype, shape, where in self._views]
        else:
            from envhub_worker.protocol.codec.arrays import ArrayReader

            arrays = self._read(ArrayReader(tail, buffers, self.limits, copy=True))
        if self._fields is None:
            return cast("T", self._message)
        return self._make(*self._fields(iter(arrays).__next__))

    def _read(self, reader: ArrayReader) -> list[Array]:
        try:
            arrays = [reader.take(descriptor) for descriptor in self._descriptors]
        except MemoryError as error:
            raise MessageTooLargeError("There is not enough memory to decode it.") from error
        reader.finish()
        return arrays


class _Place:
    """Where the next array goes."""

    __slots__ = ()


class _Places:
    """Has places for arrays, and takes note of what the document says of these."""

    def __init__(self, descriptors: list[bytes]) -> None:
        self._descriptors = descriptors

    def take(self, descriptor: bytes) -> Any:
        """The next place."""
        self._descriptors.append(descriptor)
        return _Place()

    def finish(self) -> None:
        """Whether there are as many arrays is seen when they come."""


class _IrregularError(Exception):
    """There is no form for this."""


Take = Callable[[], "Array"]


def _maker(value: Any) -> Callable[[Take], Any] | None:
    """Makes a fresh value like this one with other arrays; None where it is always the same."""
    kind = type(value)
    if kind is _Place:
        return lambda take: take()
    if kind in _CONSTANTS or kind is float:
        return None
    if kind is dict and not set(map(type, value)) - {str}:
        named = [(key, item, _maker(item)) for key, item in value.items()]
        return lambda take: {key: make(take) if make else item for key, item, make in named}
    if kind is not tuple and kind is not list:
        raise _IrregularError
    parts = [(item, _maker(item)) for item in value]
    if kind is list:
        return lambda take: [make(take) if make else item for item, make in parts]
    if all(make is None for _, make in parts):
        return None
    return lambda take: tuple([make(take) if make else item for item, make in parts])


def outline(values: list[Any]) -> tuple[Any, list[Array]] | None:
    """All that the document of these values depends on, and their arrays in its order.

    None if they hold anything but constants, numeric arrays, and small tuples, lists and dicts.
    """
    arrays: list[Array] = []
    try:
        return tuple([_outlined(value, arrays) for value in values]), arrays
    except (_IrregularError, RecursionError):  # deep or cyclic: the codec says what is wrong
        return None


def _outlined(value: Any, arrays: list[Array]) -> Any:
    kind = type(value)
    if kind.__name__ == "ndarray" and kind is getattr(sys.modules.get("numpy"), "ndarray", None):
        if value.dtype.kind not in _NUMBERS:
            raise _IrregularError
        arrays.append(value)
        return value.dtype, value.shape
    if kind is float:
        return kind, _BITS.pack(value)  # 0.0 is -0.0, and nan is not nan
    if kind in _CONSTANTS:
        if kind in _TEXTS and len(value) > _MAX_TEXT:
            raise _IrregularError
        return kind, value
    if kind is dict and len(value) <= _MAX_ITEMS:
        if set(map(type, value)) - {str}:
            raise _IrregularError
        return kind, tuple([(key, _outlined(item, arrays)) for key, item in value.items()])
    if (kind is tuple or kind is list) and len(value) <= _MAX_ITEMS:
        return kind, tuple([_outlined(item, arrays) for item in value])
    raise _IrregularError
