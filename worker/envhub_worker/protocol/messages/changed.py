"""What has changed of that which the client has had watched, in front of a reply.

A client that is told nothing may take it that each reply leaves all of it as it was.
"""

from __future__ import annotations

from collections.abc import Sequence

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.codec import Buffer
from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.protocol.messages.front import stands_in_front, things_said

MOST = 16
"""Attributes that one runner watches."""
MAX_NAME = 256
"""Characters."""
WATCHED_TYPES = frozenset({str, bytes, int, bool, type(None)})
"""Values that nobody can change from within, and that are equal only where nobody can tell them
apart: ``0.0 == -0.0``."""
_MAX_BYTES = 4 * MOST * MAX_NAME + 1024


Attribute = tuple[int, str]
"""The number of the environment, and the name."""


def in_front(attributes: Sequence[Attribute], frames: Sequence[Buffer]) -> list[Buffer]:
    """A reply's frames with these attributes in front of them."""
    return [*m.pack(m.Changed(tuple(attributes))), *frames]


def stand_in_front(frames: Sequence[Buffer]) -> bool:
    """Whether there are such attributes in front of a reply."""
    return stands_in_front(m.Changed, frames)


def read(frame: Buffer) -> list[Attribute]:
    """What the first frame says. Trust: input from the worker, bounded before it is decoded.

    Raises:
        RemoteProtocolError: They are too many, too long, or something else.
    """
    said = things_said(m.Changed, frame, most=MOST, max_bytes=_MAX_BYTES)
    return [_checked(one) for one in said]


def _checked(one: object) -> Attribute:
    if type(one) is not tuple or list(map(type, one)) != [int, str]:
        raise RemoteProtocolError("a change that the worker tells of is not that of an attribute")
    number, name = one
    return number, name
