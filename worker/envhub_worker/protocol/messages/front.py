"""What a runner says in front of a reply: a message in the first frame, the reply in the others.

Where there is something to say, a reply has at least two frames, and the first tells by its kind
what it is. Where there is nothing, nothing is sent.
"""

from __future__ import annotations

from collections.abc import Sequence

from envhub_worker.protocol.codec.codec import Buffer
from envhub_worker.protocol.errors import MessageTooLargeError, RemoteProtocolError
from envhub_worker.protocol.messages.base import Message, values_of
from envhub_worker.protocol.messages.packing import unpack

_LENGTH_BYTES = 4
"""The length of the document."""
_LIST = 0x90
"""The head of a short list of msgpack; a message is one of its kind and its fields."""


def stands_in_front(kind: type[Message], frames: Sequence[Buffer]) -> bool:
    """Whether a message of this kind is in front of a reply. Trust: two bytes are looked at."""
    if len(frames) < 2:
        return False
    head = bytes([_LIST + 1 + len(kind.FIELDS), kind.kind])
    return memoryview(frames[0]).cast("B")[_LENGTH_BYTES : _LENGTH_BYTES + len(head)] == head


def things_said(
    kind: type[Message], frame: Buffer, *, most: int, max_bytes: int
) -> tuple[object, ...]:
    """What the only field of the message in front holds. Trust: input from the worker.

    Bounded before it is decoded; what the single things are, the caller checks.

    Raises:
        RemoteProtocolError: They are too many or too large, or it is something else.
    """
    size, name = memoryview(frame).nbytes, kind.__name__
    if size > max_bytes:
        raise MessageTooLargeError(f"{size} bytes of {name} are over the limit of {max_bytes}.")
    message = unpack([frame])
    said = values_of(message)[0] if type(message) is kind else None
    if type(said) is not tuple or len(said) > most:
        raise RemoteProtocolError(f"the worker says {name} in another way than was agreed on")
    return said
