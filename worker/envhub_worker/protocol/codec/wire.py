"""What a message consists of: frames, one msgpack document, and the extensions in it.

Everything is looked at before it is decoded: how large frames are, how deep a document is, how
many items it has, how long they are. msgpack's own caps hold per container, so that documents of a
few megabytes can still make it allocate a thousand times as much. Nothing here builds a value.
``docs/values.md`` lists the extension codes, which never change.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Sequence
from typing import NoReturn

from envhub_worker.protocol.errors import (
    LocalProtocolError,
    MessageTooLargeError,
    RemoteProtocolError,
)
from envhub_worker.protocol.limits import WireLimits
from envhub_worker.protocol.records import dataclass

Buffer = bytes | memoryview
Pickler = Callable[[object], Buffer]


@dataclass(frozen=True)
class PickledValue:
    """A value that travels pickled. A ``memoryview`` becomes a frame of its own."""

    data: Buffer


# Extensions that are a value by themselves.
ARRAY, SCALAR, INTEGER, COMPLEX, PICKLE, PICKLE_FRAME = 1, 2, 3, 4, 5, 6
# Extensions that head a msgpack array and say what its other elements make.
TUPLE, SET, FROZENSET, RANGE, SLICE, OBJECTS, TEXT_SCALAR, TENSOR, ENUM, REMOTE = range(16, 26)
# Heads of descriptions, which only a client decodes: one plain value follows each.
SPACE, SPEC, GENERATOR = range(26, 29)

# The header frame: length of the msgpack document, the document, bytes of small arrays.
DOCUMENT_BYTES = struct.Struct("<I")
COMPLEX_BYTES = struct.Struct("<dd")

# torch dtype name to the numpy dtype that carries its bits.
TENSOR_DTYPES = {
    "bool": "bool", "uint8": "uint8", "int8": "int8", "int16": "int16", "int32": "int32",
    "int64": "int64", "float16": "float16", "float32": "float32", "float64": "float64",
    "complex64": "complex64", "complex128": "complex128", "bfloat16": "uint16",
}  # fmt: skip


def check_outgoing(document: bytes, frames: Sequence[Buffer], limits: WireLimits) -> None:
    """Raises ``ProtocolError`` for a message that the receiver will not accept."""
    check_document(document, limits)
    try:
        _check_sizes(frames, limits)
    except MessageTooLargeError as error:
        raise LocalProtocolError(f"The message is too large to be sent: {error}") from None


def split_frames(
    frames: Sequence[Buffer], limits: WireLimits
) -> tuple[bytes, Buffer, list[Buffer]]:
    """Checks the frames' sizes; returns document, tail of the header, and the other frames.

    Raises:
        MessageTooLargeError: Over one of ``limits``.
        RemoteProtocolError: There is no header, or not all of it.
    """
    flat = [frame if type(frame) is bytes else memoryview(frame).cast("B") for frame in frames]
    _check_sizes(flat, limits)
    header, *buffers = flat
    if len(header) < DOCUMENT_BYTES.size:
        raise RemoteProtocolError("The header is too short.")
    end = DOCUMENT_BYTES.size + DOCUMENT_BYTES.unpack_from(header)[0]
    if end > len(header):
        raise RemoteProtocolError("The header is shorter than it says.")
    return bytes(header[DOCUMENT_BYTES.size : end]), header[end:], buffers


def _check_sizes(frames: Sequence[Buffer], limits: WireLimits) -> None:
    """Raises ``MessageTooLargeError`` for too much. Frames must consist of single bytes."""
    if not frames:
        raise RemoteProtocolError("A message has no frame.")
    if len(frames) == 1 and len(frames[0]) <= min(limits.header_bytes, limits.message_bytes):
        return
    sizes = list(map(len, frames))
    for name, size, cap in (
        ("frames", len(sizes), limits.frames),
        ("header_bytes", sizes[0], limits.header_bytes),
        ("message_bytes", sum(sizes), limits.message_bytes),
        ("frame_bytes", max(sizes), max(limits.frame_bytes, sizes[0])),
    ):
        if size > cap:
            raise MessageTooLargeError(f"{size} is over the limit of {cap} ({name}).")


# Documents up to this size are let through without a walk when they look flat. Each container
# may claim as many elements as the document has bytes, which msgpack allocates at 8 bytes each.
_SMALL_BYTES = 16 * 1024
_OPENERS = bytes([*range(0x80, 0xA0), *range(0xDC, 0xE0)])
# msgpack's own ext code -1 becomes a Timestamp without asking us.
_TIMESTAMP = re.compile(rb"[\xd4-\xd8]\xff|\xc7.\xff|\xc8..\xff|\xc9....\xff", re.DOTALL)

# The entry of an empty container in the table of widths.
_NO_ELEMENTS = -1
_MAP, _ARRAY, _TEXT, _BINARY, _EXT = range(5)


def check_document(document: bytes, limits: WireLimits) -> None:
    """Refuses a msgpack document whose decoding would not be bounded.

    Trust: input from the worker.

    Raises:
        MessageTooLargeError: The document exceeds ``limits`` of depth, length or items.
        RemoteProtocolError: It is not msgpack, or contains a type that this protocol does not use.
    """
    # First a cheap check, which most documents within all limits pass.
    if len(document) <= min(_SMALL_BYTES, limits.items, limits.text_bytes):
        openers = len(document) - len(document.translate(None, _OPENERS))
        if openers <= limits.depth and not (0xFF in document and _TIMESTAMP.search(document)):
            return
    _walk(document, limits)


def _walk(document: bytes, limits: WireLimits) -> None:
    """Steps over every token once; raises as ``check``."""
    position, end, items, remaining = 0, len(document), 1, 1
    pending: list[int] = []
    while True:
        while not remaining:
            if not pending:
                return
            remaining = pending.pop()
        if position >= end:
            raise RemoteProtocolError("The header ends in the middle of a value.")
        remaining -= 1
        width = _WIDTHS[document[position]]
        if width > 0:
            position += width
            continue
        if width < 0:
            count = _NO_ELEMENTS - width
            position += 1
        else:
            count, position = _read_long(document, position, limits)
            if count < 0:
                continue
        items += count
        if count > end - position or items > limits.items or len(pending) >= limits.depth:
            _refuse_container(items, len(pending), limits)
        if count:
            pending.append(remaining)
            remaining = count


def _read_long(document: bytes, position: int, limits: WireLimits) -> tuple[int, int]:
    """Returns the elements of a container and the position of the first.

    For a text, binary or extension returns -1 and the position after its content.
    """
    first = document[position]
    if first not in _LENGTHS:
        raise RemoteProtocolError("The header is not msgpack.")
    kind, length_bytes, length = _LENGTHS[first]
    position += 1
    if length_bytes:
        length = int.from_bytes(document[position : position + length_bytes], "big")
        position += length_bytes
    if kind <= _ARRAY:
        return (2 * length if kind == _MAP else length), position
    if kind == _TEXT and length > limits.text_bytes:
        raise MessageTooLargeError(
            f"A text of {length} bytes is over {limits.text_bytes} (text_bytes)."
        )
    if kind == _EXT:
        if document[position : position + 1] == b"\xff":
            raise RemoteProtocolError("The header holds a msgpack timestamp.")
        position += 1
    return -1, position + length


def _refuse_container(items: int, depth: int, limits: WireLimits) -> NoReturn:
    if items > limits.items:
        raise MessageTooLargeError(f"More than {limits.items} items (items) in one message.")
    if depth >= limits.depth:
        raise MessageTooLargeError(f"Containers are nested deeper than {limits.depth} (depth).")
    raise RemoteProtocolError("A container claims more elements than the header has bytes.")


def _widths() -> tuple[int, ...]:
    """A table by first byte: a positive entry is the token's bytes, a negative one its elements,
    0 is neither.

    Elements are counted down from ``_NO_ELEMENTS``, so that an empty container is negative too.
    """
    table = [0] * 256
    for length in range(16):
        table[0x80 + length] = _NO_ELEMENTS - 2 * length
        table[0x90 + length] = _NO_ELEMENTS - length
    for first in (*range(0x80), 0xC0, 0xC2, 0xC3, *range(0xE0, 0x100)):
        table[first] = 1
    for first in range(0xA0, 0xC0):
        table[first] = 1 + (first & 0x1F)
    for group, sizes in ((0xCA, (4, 8)), (0xCC, (1, 2, 4, 8)), (0xD0, (1, 2, 4, 8))):
        for offset, size in enumerate(sizes):
            table[group + offset] = 1 + size
    return tuple(table)


def _lengths() -> dict[int, tuple[int, int, int]]:
    """First byte to (kind, bytes of the length field, length where there is no field)."""
    table = {}
    for offset, size in enumerate((1, 2, 4)):
        table[0xC4 + offset] = (_BINARY, size, 0)
        table[0xC7 + offset] = (_EXT, size, 0)
        table[0xD9 + offset] = (_TEXT, size, 0)
    for offset, size in enumerate((1, 2, 4, 8, 16)):
        table[0xD4 + offset] = (_EXT, 0, size)
    for offset, size in enumerate((2, 4)):
        table[0xDC + offset] = (_ARRAY, size, 0)
        table[0xDE + offset] = (_MAP, size, 0)
    return table


_WIDTHS = _widths()
_LENGTHS = _lengths()
