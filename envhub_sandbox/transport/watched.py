"""What the runners of a jail watch for us: attributes that stay as they are until they say other.

Each reply says by its silence that they are what they were, so an evaluation that asks for its
task after every step need not be answered by anybody. Trust: values are the worker's words, as
those of a ``call`` are; what is kept cannot be changed by whoever gets it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from envhub_worker.protocol.codec.codec import Buffer
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from envhub_worker.protocol.messages import changed
from envhub_worker.protocol.untrusted import UNTRUSTED


class Watched:
    """The values, by the number of the environment and the attribute's name."""

    def __init__(self) -> None:
        self._values: dict[changed.Attribute, tuple[Any, ...]] = {}

    def note(self, number: int, name: str, values: tuple[Any, ...]) -> bool:
        """Keep what was read, as long as it is watched; whether it can be kept."""
        if not all(type(value) in changed.WATCHED_TYPES for value in values):
            return False
        self._values[number, name] = values
        return True

    def values(self, number: int, name: str) -> tuple[Any, ...] | None:
        """One for each sub-environment; None if nobody knows."""
        return self._values.get((number, name))

    def forget(self) -> None:
        """Other runners are there, or a reply was lost."""
        self._values.clear()

    def take(self, frames: Sequence[Buffer]) -> Sequence[Buffer]:
        """A reply's own frames, without the changes in front. Trust: input from the worker.

        Raises:
            RemoteProtocolError: These are not what was agreed on.
        """
        if len(frames) >= DEFAULT_LIMITS.frames:  # there was no room in front
            self.forget()
        if not changed.stand_in_front(frames):
            return frames
        with UNTRUSTED:
            for attribute in changed.read(frames[0]):
                self._values.pop(attribute, None)
        return frames[1:]
