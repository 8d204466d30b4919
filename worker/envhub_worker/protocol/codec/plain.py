"""Documents of plain values, without numpy: what a server says and is told.

A worker server handles no arrays: it passes on the frames that hold any. So it need not wait for
numpy, as long as nobody sends it one. What is not plain is left to the codec, which says what it
is, or what is wrong with it; of what is plain the two make the same, byte for byte.
"""

from __future__ import annotations

from typing import Any

import msgpack  # type: ignore[import-untyped]

from envhub_worker.protocol.codec import structure
from envhub_worker.protocol.codec.frames import check_outgoing
from envhub_worker.protocol.codec.kinds import DOCUMENT_BYTES, TUPLE, Buffer
from envhub_worker.protocol.errors import ProtocolError
from envhub_worker.protocol.limits import WireLimits

NOT_PLAIN = object()
_FEW_KEYS = 64
"""In larger maps the codec looks at the keys."""


def encode(value: object, limits: WireLimits) -> Buffer | None:
    """The one frame of a value; None where the codec has to be asked."""
    try:
        document: bytes = msgpack.packb(value, default=_listed, strict_types=True)
        structure.check(document, limits)
        frame = DOCUMENT_BYTES.pack(len(document)) + document
        check_outgoing([frame], limits)
    except Exception:  # the codec says what is wrong, and where
        return None
    return frame


def _listed(value: object) -> object:
    if type(value) is not tuple:
        raise TypeError
    return [_HEAD, *value]


def decode(document: bytes, limits: WireLimits) -> object:
    """The value; ``NOT_PLAIN`` where the codec has to be asked. Trust: input from the other side.

    Raises:
        MessageTooLargeError: Over one of ``limits``.
        RemoteProtocolError: Not msgpack.
    """
    structure.check(document, limits)
    try:
        reader = _Reader()
        value = msgpack.unpackb(
            document,
            ext_hook=reader.extension,
            list_hook=reader.list,
            object_pairs_hook=_map,
            strict_map_key=False,
        )
    except ProtocolError:
        raise
    except Exception:
        return NOT_PLAIN
    return NOT_PLAIN if reader.heads else value


class _Reader:
    """msgpack's hooks; counts the heads of tuples that do not stand in front."""

    def __init__(self) -> None:
        self.heads = 0

    def extension(self, code: int, payload: bytes) -> object:
        if code != TUPLE or payload:
            raise TypeError
        self.heads += 1
        return _HEAD

    def list(self, items: list[Any]) -> object:
        if not items or items[0] is not _HEAD:
            return items
        self.heads -= 1
        return tuple(items[1:])


def _map(pairs: list[tuple[Any, Any]]) -> dict[Any, Any]:
    if len(pairs) > _FEW_KEYS:  # first: keys may be chosen so that their hashes collide
        raise TypeError
    made = dict(pairs)
    if len(made) != len(pairs):
        raise TypeError
    return made


_HEAD = msgpack.ExtType(TUPLE, b"")
