"""Looks at a msgpack document before it is decoded: how deep, how many items, how long.

msgpack's own caps hold per container, so that documents of a few megabytes can still make it
allocate a thousand times as much. Nothing here builds a value.
"""

from __future__ import annotations

import re
from typing import NoReturn

from envhub_worker.protocol.errors import MessageTooLargeError, RemoteProtocolError
from envhub_worker.protocol.limits import WireLimits

# Documents up to this size are let through without a walk when they look flat. Each container
# may claim as many elements as the document has bytes, which msgpack allocates at 8 bytes each.
_SMALL_BYTES = 16 * 1024
_OPENERS = bytes([*range(0x80, 0xA0), *range(0xDC, 0xE0)])
# msgpack's own ext code -1 becomes a Timestamp without asking us.
_TIMESTAMP = re.compile(rb"[\xd4-\xd8]\xff|\xc7.\xff|\xc8..\xff|\xc9....\xff", re.DOTALL)

# What an empty container has in the table of widths.
_NO_ELEMENTS = -1
_MAP, _ARRAY, _TEXT, _BINARY, _EXT = range(5)


def check(document: bytes, limits: WireLimits) -> None:
    """Refuses a msgpack document whose decoding would not be bounded.

    Trust: input from the worker.

    Raises:
        MessageTooLargeError: Deeper, longer or more numerous than ``limits``.
        RemoteProtocolError: Not msgpack, or of a kind this protocol has no use for.
    """
    if not _looks_flat(document, limits):
        _walk(document, limits)


def _looks_flat(document: bytes, limits: WireLimits) -> bool:
    """Says cheaply that a document is harmless; it may say no to harmless ones."""
    if len(document) > min(_SMALL_BYTES, limits.items, limits.text_bytes):
        return False
    openers = len(document) - len(document.translate(None, _OPENERS))
    return openers <= limits.depth and not (0xFF in document and _TIMESTAMP.search(document))


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
    kind, length, position = _read_length(document, position)
    if kind <= _ARRAY:
        return (2 * length if kind == _MAP else length), position
    if kind == _TEXT and length > limits.text_bytes:
        raise MessageTooLargeError(
            f"A text of {length} bytes is over {limits.text_bytes} (text_bytes)."
        )
    return -1, position + length


def _read_length(document: bytes, position: int) -> tuple[int, int, int]:
    """Returns kind, declared length, and the position of the content or first element."""
    first = document[position]
    if first not in _LENGTHS:
        raise RemoteProtocolError("The header is not msgpack.")
    kind, length_bytes, length = _LENGTHS[first]
    position += 1
    if length_bytes:
        length = int.from_bytes(document[position : position + length_bytes], "big")
        position += length_bytes
    if kind == _EXT:
        if document[position : position + 1] == b"\xff":
            raise RemoteProtocolError("The header holds a msgpack timestamp.")
        position += 1
    return kind, length, position


def _refuse_container(items: int, depth: int, limits: WireLimits) -> NoReturn:
    if items > limits.items:
        raise MessageTooLargeError(f"More than {limits.items} items (items) in one message.")
    if depth >= limits.depth:
        raise MessageTooLargeError(f"Containers are nested deeper than {limits.depth} (depth).")
    raise RemoteProtocolError("A container claims more elements than the header has bytes.")


def _widths() -> tuple[int, ...]:
    """By first byte: bytes of the whole token if positive, elements if negative, 0 for neither.

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
