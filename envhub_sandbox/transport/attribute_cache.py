"""Values of attributes that the runners of a jail watch for changes.

A reply names the attributes that have changed before it; the others have the values that are kept
here, and need no request. Trust: the values come from the worker, as those of a ``call`` do. They
are of immutable types, so a caller cannot change what is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from envhub_worker.protocol.codec.codec import Buffer
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from envhub_worker.protocol.messages.prefix import CHANGES, WATCHED_TYPES, Attribute


class AttributeCache:
    """The values, by the number of the environment and the attribute's name."""

    def __init__(self) -> None:
        self._values: dict[Attribute, tuple[Any, ...]] = {}

    def note(self, number: int, name: str, values: tuple[Any, ...]) -> bool:
        """Keep values that were read. Returns whether they can be kept."""
        if not all(type(value) in WATCHED_TYPES for value in values):
            return False
        self._values[number, name] = values
        return True

    def values(self, number: int, name: str) -> tuple[Any, ...] | None:
        """One for each sub-environment; None if they are not known."""
        return self._values.get((number, name))

    def forget(self) -> None:
        """Drop all: a runner was replaced, or a reply was lost."""
        self._values.clear()

    def take(self, frames: Sequence[Buffer]) -> Sequence[Buffer]:
        """A reply's own frames, without the changes in front. Trust: input from the worker.

        Raises:
            RemoteProtocolError: These are not what was agreed on.
        """
        if len(frames) >= DEFAULT_LIMITS.frames:  # there was no room in front
            self.forget()
        changed, rest = CHANGES.read(frames)
        for attribute in changed:
            self._values.pop(attribute, None)
        return rest
