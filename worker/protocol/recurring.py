"""What recurs in messages: documents that differ in nothing but the id, and in their arrays' bytes.

In a run of steps nearly every message is of that kind. So what the codec has made of a document
is kept, when it is met again: a *form*, into which only the arrays are put. The key is the whole
document, or all that it depends on, so a form says exactly what the codec would say. Forms are
few and small: a peer that sends nothing twice gains nothing and costs nothing.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import msgpack  # type: ignore[import-untyped]
import numpy as np

from envhub_worker.protocol.arrays import Array, ArrayReader, ArrayWriter, Buffer
from envhub_worker.protocol.codec import check_outgoing, split
from envhub_worker.protocol.kinds import ARRAY, DOCUMENT_BYTES, TUPLE
from envhub_worker.protocol.limits import WireLimits

_MAX_DOCUMENT_BYTES = 1024
_MAX_FORMS = 256
_MAX_ITEMS = 32
_MAX_TEXT = 256
_CONSTANTS = frozenset({int, bool, str, bytes, type(None)})
_BITS = struct.Struct("<d")
_TEXTS = frozenset({str, bytes})
_NUMBERS = frozenset("biufc")
_ID = 2
"""Where a message's id begins: after the array's head and the kind, a byte each."""
_ID_BYTES = {0xCC: 2, 0xCD: 3, 0xCE: 5, 0xCF: 9}

K = TypeVar("K")
F = TypeVar("F")
T = TypeVar("T")


class Forms(Generic[K, F]):
    """Forms by key; one is made when its key is met for the second time."""

    def __init__(self) -> None:
        self._forms: dict[K, F | None] = {}
        self.get = self._forms.get

    def met(self, key: K, make: Callable[[], F]) -> None:
        """Take note of a key that has no form."""
        if key in self._forms:
            self._forms[key] = make()
        elif len(self._forms) < _MAX_FORMS:
            self._forms[key] = None
        else:
            self._forms.clear()


class Outgoing:
    """How to pack messages of one outline.

    Attributes:
        limits: For which it holds; None if it does not hold at all.
    """

    __slots__ = ("_after", "_before", "limits")

    def __init__(self, header: Buffer, limits: WireLimits) -> None:
        cut = without_id(split([header], limits)[0])
        self.limits = None if cut is None else limits
        document = b"" if cut is None else cut[0]
        self._before, self._after = document[:_ID], document[_ID:]

    def frames(self, request_id: int, arrays: list[Array]) -> list[Buffer]:
        """What ``encode`` would return.

        Raises:
            LocalProtocolError: More than the receiver accepts.
        """
        assert self.limits is not None
        packed_id = msgpack.packb(request_id)
        document = b"".join((self._before, packed_id, self._after))
        writer = ArrayWriter()
        for array in arrays:
            writer.add(array)
        prefix = DOCUMENT_BYTES.pack(len(document))
        frames: list[Buffer] = [b"".join((prefix, document, *writer.tail)), *writer.frames]
        check_outgoing(frames, self.limits)
        return frames


class Incoming(Generic[T]):
    """What to make of a document that was decoded before.

    Args:
        document: With its id.
        make: Makes the message of its fields.
        limits: For which it was decoded.

    Attributes:
        limits: For which it holds; None if it does not hold at all.
    """

    __slots__ = ("_make", "_message", "_shape", "limits")

    def __init__(self, document: bytes, make: Callable[..., T], limits: WireLimits) -> None:
        self._make = make
        self._message: T | None = None
        self._shape: list[Any] = []
        self.limits: WireLimits | None = limits
        try:
            _, _, *self._shape = _shaped(msgpack.unpackb(document, strict_map_key=False))
        except _IrregularError:
            self.limits = None
        else:
            if all(map(_is_constant, self._shape)):
                self._message = make(*self._shape)

    def message(self, tail: Buffer, buffers: list[Buffer]) -> T:
        """The message with these arrays. Trust: as ``decode``.

        Raises:
            RemoteProtocolError: Their bytes are not what the document says.
        """
        assert self.limits is not None
        reader = ArrayReader(tail, buffers, self.limits, copy=True)
        if self._message is not None:
            message = self._message
        else:
            message = self._make(*[_fill(shape, reader.take) for shape in self._shape])
        reader.finish()
        return message


def without_id(document: bytes) -> tuple[bytes, bytes] | None:
    """A message's document without the id, and the id's own bytes; None if that is not plain."""
    if not _ID < len(document) <= _MAX_DOCUMENT_BYTES:
        return None
    array, kind, first = document[: _ID + 1]
    size = 1 if first < 0x80 else _ID_BYTES.get(first, 0)
    if not (size and 0x92 <= array <= 0x9F and kind < 0x80):
        return None
    return document[:_ID] + document[_ID + size :], document[_ID : _ID + size]


def read_id(packed: bytes) -> int:
    """The id of its own bytes."""
    return int.from_bytes(packed if len(packed) == 1 else packed[1:], "big")


class _Place:
    """Where an array goes; ``descriptor`` is what the document says of it."""

    __slots__ = ("descriptor",)

    def __init__(self, descriptor: bytes) -> None:
        self.descriptor = descriptor


class _IrregularError(Exception):
    """There is no form for this."""


def _shaped(value: Any) -> Any:
    kind = type(value)
    if kind is msgpack.ExtType:
        if value.code != ARRAY:
            raise _IrregularError
        return _Place(value.data)
    if kind is dict:
        if set(map(type, value)) - {str}:
            raise _IrregularError
        return {key: _shaped(item) for key, item in value.items()}
    if kind is list:
        if value and type(value[0]) is msgpack.ExtType and value[0].code == TUPLE:
            return tuple(map(_shaped, value[1:]))
        return list(map(_shaped, value))
    return value


def _is_constant(shape: Any) -> bool:
    """Whether every message of this shape is the same object, as far as anybody can tell."""
    if type(shape) is tuple:
        return all(map(_is_constant, shape))
    return type(shape) not in (_Place, dict, list)


def _fill(shape: Any, take: Callable[[bytes], Array]) -> Any:
    """A fresh value of a shape; ``take`` gives the arrays, in their order."""
    kind = type(shape)
    if kind is _Place:
        return take(shape.descriptor)
    if kind is dict:
        return {key: _fill(item, take) for key, item in shape.items()}
    if kind is tuple:
        return tuple([_fill(item, take) for item in shape])
    if kind is list:
        return [_fill(item, take) for item in shape]
    return shape


def outline(values: list[Any]) -> tuple[Any, list[Array]] | None:
    """All that the document of these values depends on, and their arrays in its order.

    None if they hold anything but constants, numeric arrays, and small tuples, lists and dicts.
    """
    arrays: list[Array] = []
    try:
        return tuple([_outlined(value, arrays) for value in values]), arrays
    except _IrregularError:
        return None


def _outlined(value: Any, arrays: list[Array]) -> Any:
    kind = type(value)
    if kind is np.ndarray:
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
