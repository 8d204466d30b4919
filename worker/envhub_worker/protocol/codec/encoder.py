"""Values to one msgpack document and the bytes of its arrays.

It needs no numpy: a worker server passes on frames that hold arrays unread, and starts sooner
without. ``arrays`` has the forms of arrays, and is loaded with the first value that needs it.
"""

from __future__ import annotations

import contextlib
import sys
from collections import deque
from collections.abc import Callable, Sequence
from enum import Enum
from functools import cache
from operator import attrgetter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import msgpack  # type: ignore[import-untyped]

from envhub_worker.protocol.codec import wire
from envhub_worker.protocol.codec.inert import RemoteEnum, RemoteObject, inert_copy, inert_enum
from envhub_worker.protocol.codec.wire import Buffer, PickledValue, Pickler
from envhub_worker.protocol.errors import LocalProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits

if TYPE_CHECKING:
    from envhub_worker.protocol.codec.arrays import ArrayWriter

Describer = Callable[[object], "tuple[int, object] | None"]
"""Returns the code and plain value of an object that the peer can rebuild; None for others."""


class Encoder:
    """Turns one value into frames; msgpack calls ``default`` for what it cannot pack itself."""

    __slots__ = ("describer", "limits", "pickler", "writer")

    def __init__(
        self, pickler: Pickler | None, limits: WireLimits, describer: Describer | None = None
    ) -> None:
        self.pickler, self.limits, self.describer = pickler, limits, describer
        self.writer: ArrayWriter | None = None  # made for the first array of the message

    def frames(self, value: object) -> list[Buffer]:
        """Returns the header frame and the arrays' frames."""
        options: dict[str, Any] = {"default": self.default, "strict_types": True}
        try:
            document = msgpack.packb(value, **options)
        except UnicodeEncodeError:
            # Lone surrogates are not UTF-8. They arrive as the text "\\udc80", visibly.
            self.writer = None
            document = msgpack.packb(value, **options, unicode_errors="backslashreplace")
        prefix = wire.DOCUMENT_BYTES.pack(len(document))
        frames: list[Buffer] = [prefix + document]
        if self.writer is not None:
            frames = [b"".join((prefix, document, *self.writer.tail)), *self.writer.frames]
        wire.check_outgoing(document, frames, self.limits)
        return frames

    def default(self, value: Any) -> object:
        """Returns what msgpack packs in place of ``value``."""
        return _WRITERS.get(type(value), _write_other)(self, value)

    def unknown(self, value: object) -> object:
        """Pickles or describes what has no form."""
        if self.pickler is None:
            description = None if self.describer is None else self.describer(value)
            if description is not None:
                return [_HEADS[description[0]], description[1]]
            return self.default(inert_copy(value))
        try:
            data = self.pickler(value)
        except Exception as error:
            text = f"{type(value).__name__} cannot be pickled: {error}"
            raise LocalProtocolError(text) from error
        return _write_pickled(self, PickledValue(data))


def _write_integer(encoder: Encoder, value: int) -> object:
    size = value.bit_length() // 8 + 1
    if size > encoder.limits.int_bytes:
        raise LocalProtocolError(f"an integer of {size} bytes")
    return msgpack.ExtType(wire.INTEGER, value.to_bytes(size, "little", signed=True))


def _write_complex(encoder: Encoder, value: complex) -> object:
    return msgpack.ExtType(wire.COMPLEX, wire.COMPLEX_BYTES.pack(value.real, value.imag))


def _write_pickled(encoder: Encoder, pickled: PickledValue) -> object:
    data = pickled.data
    if type(data) is bytes:
        return msgpack.ExtType(wire.PICKLE, data)
    import numpy as np

    from envhub_worker.protocol.codec.arrays import add

    described = add(encoder, np.frombuffer(data, np.uint8))
    return msgpack.ExtType(wire.PICKLE_FRAME, described.data)


def _write_other(encoder: Encoder, value: Any) -> object:
    """Handles subclasses, arrays and tensors of other libraries, and the unknown."""
    if "numpy" in sys.modules:
        form = _numpy_writer()(encoder, value)
        if form is not NotImplemented:
            return form
    # Subclasses cross as the type that they extend, which they equal: an IntEnum's member as int.
    for base, plain in _PLAIN.items():
        if isinstance(value, base):
            return plain(value)
    for base in _BASES:
        if isinstance(value, base):
            return _WRITERS[base](encoder, value)
    if isinstance(value, Enum):
        return [_HEADS[wire.ENUM], *inert_enum(value), value.value]
    return encoder.unknown(value)


@cache
def _numpy_writer() -> Callable[[Encoder, Any], object]:
    from envhub_worker.protocol.codec import arrays

    _WRITERS.update(arrays.WRITERS)
    return arrays.write_numpy


def _headed(code: int, *names: str) -> Callable[[Encoder, Any], object]:
    """Writes a list: the type code, then the named attributes, or the elements without names."""
    head = _HEADS[code]
    parts = attrgetter(*names) if names else iter

    def write(encoder: Encoder, value: Any) -> object:
        return [head, *parts(value)]

    return write


_HEADS = {code: msgpack.ExtType(code, b"") for code in range(wire.TUPLE, wire.GENERATOR + 1)}

_WRITERS: dict[type, Callable[[Encoder, Any], object]] = {
    int: _write_integer,
    tuple: _headed(wire.TUPLE),
    set: _headed(wire.SET),
    frozenset: _headed(wire.FROZENSET),
    complex: _write_complex,
    range: _headed(wire.RANGE, "start", "stop", "step"),
    slice: _headed(wire.SLICE, "start", "stop", "step"),
    PickledValue: _write_pickled,
    RemoteObject: _headed(wire.REMOTE, "type_name", "text"),
    RemoteEnum: _headed(wire.ENUM, "type_name", "text", "value"),
}
_PLAIN: dict[type, Callable[[Any], object]] = {
    str: str.__str__,
    float: float.__float__,
    dict: dict,
    list: list,
    bytes: bytes,
    MappingProxyType: dict,
    deque: list,
}
_BASES = (int, tuple, complex, set, frozenset)


def encode(
    value: object,
    pickler: Pickler | None = None,
    limits: WireLimits = DEFAULT_LIMITS,
    names: Sequence[str] = (),
    describer: Describer | None = None,
    *,
    reduces: bool = False,
) -> list[Buffer]:
    """Encodes a value as frames: the header, then one per large array.

    Args:
        value: Plain Python values, numpy arrays and scalars, torch tensors, nested in any way.
            Anything else crosses as ``RemoteObject``.
        pickler: Encodes objects that have no form of their own instead. Client to worker only.
        limits: What the receiver accepts.
        names: What to call the elements of the value in an error.
        describer: Describes objects that the receiver rebuilds. Worker to client only.
        reduces: Whether a ``RemoteObject`` may stand in the place of a part that cannot be sent.

    Returns:
        Frames to be sent in this order. Large contiguous arrays are not copied, and must
        not be written until the frames are sent.

    Raises:
        LocalProtocolError: The value is cyclic, too deep, too large, or holds a dtype that
            cannot cross. The text names the path to the offender. Nothing was sent.
    """

    def send(part: object) -> list[Buffer]:
        return Encoder(pickler, limits, describer).frames(part)

    try:
        return send(value)
    # The object's own code runs here (__array__, iteration) and can raise anything.
    except Exception as error:
        from envhub_worker.protocol.codec.unsendable import explain, reduced

        if reduces and type(value) is list:
            with contextlib.suppress(Exception):
                return send(reduced(value, send, limits))
        raise LocalProtocolError(explain(value, error, limits, send, names)) from error
