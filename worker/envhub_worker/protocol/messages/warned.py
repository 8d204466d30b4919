"""What a repository has warned of, in front of the reply that comes after it.

Where there is something, a runner puts the frame of a ``Warned`` in front of its reply's frames:
then there are at least two, and the first says what it is. Where there is nothing, nothing is sent.
"""

from __future__ import annotations

from collections.abc import Sequence

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.codec import Buffer
from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.protocol.messages.front import stands_in_front, things_said

MOST_AT_ONCE = 16
"""Warnings of one reply."""
MAX_CATEGORY = 256
MAX_TEXT = 2048
"""Characters."""
_MAX_BYTES = 4 * MOST_AT_ONCE * (MAX_CATEGORY + MAX_TEXT) + 1024

Told = tuple[str, str]
"""The category's name, and the text."""


def in_front(warnings: Sequence[Told], frames: Sequence[Buffer]) -> list[Buffer]:
    """A reply's frames with these warnings in front of them."""
    return [*m.pack(m.Warned(tuple(warnings))), *frames]


def stand_in_front(frames: Sequence[Buffer]) -> bool:
    """Whether there are warnings in front of a reply."""
    return stands_in_front(m.Warned, frames)


def read(frame: Buffer) -> list[Told]:
    """The warnings of the first frame. Trust: input from the worker, bounded before it is decoded.

    Raises:
        RemoteProtocolError: They are too many, too long, or something else.
    """
    said = things_said(m.Warned, frame, most=MOST_AT_ONCE, max_bytes=_MAX_BYTES)
    return [_checked(one) for one in said]


def _checked(one: object) -> Told:
    if type(one) is not tuple or list(map(type, one)) != [str, str]:
        raise RemoteProtocolError("a warning of the worker is not a category and a text")
    category, text = one
    if len(category) > MAX_CATEGORY or len(text) > MAX_TEXT:
        raise RemoteProtocolError("a warning of the worker is too long")
    return category, text
