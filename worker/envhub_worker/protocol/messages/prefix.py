"""Prefixes of replies: a message of the runner's own in the first frame, the reply in the others.

A reply with a prefix has at least two frames, and the kind of the first names the prefix. A runner
with nothing to report sends no prefix: a reply without ``CHANGES`` means that no watched attribute
has changed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

from envhub_worker.protocol.codec.wire import Buffer
from envhub_worker.protocol.errors import UNTRUSTED, MessageTooLargeError, RemoteProtocolError
from envhub_worker.protocol.messages.message import Message, pack, unpack, values_of
from envhub_worker.protocol.messages.runner import Changes, Warnings

MAX_CATEGORY = 256
MAX_TEXT = 2048
"""Characters of a warning."""
MAX_ATTRIBUTE = 256
"""Characters of a watched attribute's name."""
WATCHED_TYPES = frozenset({str, bytes, int, bool, type(None)})
"""Values that cannot change from within, and that are the same if they are equal. Floats are not:
``0.0 == -0.0``."""

SHARED_CATEGORY = "shared state"
"""In the place of a warning's category: sub-environments of one process share what the text names.
No class is called so."""
SHARED_STATE = {
    "numpy.random": "numpy's global generator (np.random)",
    "random": "the global generator of Python's random",
    "torch": "torch's global generator",
    "module": "attributes of a module or a class",
    "environment": "environment variables",
    "directory": "the working directory",
}
"""State that all sub-environments of a process share, and the client's name for it."""

RemoteWarning = tuple[str, str]
"""The category's name, and the text."""
Attribute = tuple[int, str]
"""The number of the environment, and the name."""
T = TypeVar("T")

_LENGTH_BYTES = 4
"""Bytes of the field with the length of the document."""
_LIST = 0x90
"""The head of a short list of msgpack; a message is one of its kind and its fields."""


class Prefix(Generic[T]):
    """One kind of prefix: a message with one field, a tuple of items.

    Args:
        kind: The class of the message.
        item_bytes: Maximum size of one item.
        check: Makes an item of a decoded value, or raises ``RemoteProtocolError``.

    Attributes:
        most: Maximum number of items in one prefix.
    """

    most = 16

    def __init__(self, kind: type[Message], item_bytes: int, check: Callable[[object], T]) -> None:
        self._kind, self._check = kind, check
        self._max_bytes = self.most * item_bytes + 1024
        self._head = bytes([_LIST + 1 + len(kind.FIELDS), kind.kind])

    def put(self, things: Sequence[T], frames: Sequence[Buffer]) -> list[Buffer]:
        """Puts items in front of a reply's frames."""
        return [*pack(self._kind(tuple(things))), *frames]

    def read(self, frames: Sequence[Buffer]) -> tuple[list[T], Sequence[Buffer]]:
        """Returns the items of a prefix and the reply's own frames. Trust: input from the worker.
        Raises ``RemoteProtocolError``: the items are too many, too large, or of another type.
        """
        end = _LENGTH_BYTES + len(self._head)
        if len(frames) < 2 or memoryview(frames[0]).cast("B")[_LENGTH_BYTES:end] != self._head:
            return [], frames
        with UNTRUSTED:
            size, name = memoryview(frames[0]).nbytes, self._kind.__name__
            if size > self._max_bytes:
                text = f"{size} bytes of {name} are over the limit of {self._max_bytes}."
                raise MessageTooLargeError(text)
            message = unpack(frames[:1])
            items = values_of(message)[0] if type(message) is self._kind else None
            if type(items) is not tuple or len(items) > self.most:
                text = f"the worker sent {name} in another form than was agreed on"
                raise RemoteProtocolError(text)
            return list(map(self._check, items)), frames[1:]


def _warning(value: object) -> RemoteWarning:
    if type(value) is not tuple or list(map(type, value)) != [str, str]:
        raise RemoteProtocolError("a warning of the worker is not a category and a text")
    category, text = value
    if len(category) > MAX_CATEGORY or len(text) > MAX_TEXT:
        raise RemoteProtocolError("a warning of the worker is too long")
    if category == SHARED_CATEGORY and text not in SHARED_STATE:
        raise RemoteProtocolError("the worker reports shared state of an unknown kind")
    return category, text


def _attribute(value: object) -> Attribute:
    if type(value) is not tuple or list(map(type, value)) != [int, str]:
        raise RemoteProtocolError("the worker reports a change of what is not an attribute")
    number, name = value
    return number, name


WARNINGS = Prefix(Warnings, 4 * (MAX_CATEGORY + MAX_TEXT), _warning)
"""What the repository has warned of."""
CHANGES = Prefix(Changes, 4 * MAX_ATTRIBUTE, _attribute)
"""Attributes whose value has changed since the client read it. They are no longer watched."""
