"""Hand-made messages, for tests of what a hostile or older peer may send."""

from __future__ import annotations

import struct
from typing import Any

import msgpack

from envhub_worker.protocol.codec.codec import Buffer


def message(document: bytes, tail: bytes = b"", *frames: bytes) -> list[Buffer]:
    """Frames around a hand-made msgpack document."""
    return [struct.pack("<I", len(document)) + document + tail, *frames]


def ext(code: int, payload: bytes = b"") -> msgpack.ExtType:
    """An extension, for hand-made documents."""
    return msgpack.ExtType(code, payload)


def packed(value: object) -> list[Buffer]:
    """Frames around what plain msgpack makes of a value."""
    return message(msgpack.packb(value))


def deep(levels: int) -> list[Any]:
    """Lists in lists."""
    value: list[Any] = []
    for _ in range(levels - 1):
        value = [value]
    return value
