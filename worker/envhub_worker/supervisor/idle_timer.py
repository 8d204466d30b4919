"""How long a jail has been idle: no request, and no step.

Steps by the fast lane do not pass the server. But their slabs do, on their way to the runner: the
client counts its requests in one, which a runner cannot write, and the runner its replies in
another.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from time import monotonic

from envhub_worker.protocol.shared_memory.words import SEQUENCE
from envhub_worker.spawn.channel import close_fds

_WORD = 8


class IdleTimer:
    """The clock of one jail."""

    def __init__(self, limit_s: float) -> None:
        self.limit_s = limit_s
        self._slabs: dict[int, list[int]] = {}
        self._seen: list[int] = []
        self.begin()

    def begin(self) -> None:
        """Something was asked, or answered."""
        self._since = monotonic()

    def watch(self, runner: int, fds: Sequence[int]) -> None:
        """Count a runner's steps, too. Takes the descriptors over: request slab and reply slab."""
        self.forget(runner)
        self._slabs[runner] = list(fds)

    def forget(self, runner: int) -> None:
        """A runner has gone, or there was none."""
        close_fds(self._slabs.pop(runner, []))

    def close(self) -> None:
        """Give all descriptors back."""
        for runner in list(self._slabs):
            self.forget(runner)

    def passed(self, busy: bool) -> bool:
        """Whether it was too long; ``busy``: some runner owes an answer to a message."""
        asked = [_sequence(request) for request, _ in self._slabs.values()]
        answered = [_sequence(reply) for _, reply in self._slabs.values()]
        if busy or asked != answered or asked + answered != self._seen:
            self._seen = asked + answered
            self.begin()
        return monotonic() - self._since >= self.limit_s


def _sequence(slab: int) -> int:
    return int.from_bytes(os.pread(slab, _WORD, SEQUENCE * _WORD), "little")
