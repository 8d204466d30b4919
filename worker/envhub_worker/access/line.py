"""Who waits for room: first come, first served, among the processes of one key."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

RETRY_S = 1.0
"""When to ask again. Whoever does not keeps nobody waiting."""
_PATIENCE_S = 5.0
_MAX_WAITING = 1024


@dataclass
class _Waiting:
    asked: float
    times: int = 1


class Line:
    """The order in which clients first asked, as long as they go on asking.

    Who has asked once may not mean to wait, and so stands in nobody's way; who asks again does.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._waiting: dict[bytes, OrderedDict[bytes, _Waiting]] = {}

    @property
    def waiting(self) -> int:
        """How many mean to wait: they have asked more than once, and not long ago."""
        now = self._clock()
        return sum(
            one.times > 1 and now - one.asked <= _PATIENCE_S
            for waiting in self._waiting.values()
            for one in waiting.values()
        )

    def ahead(self, key: bytes, owner: bytes) -> int:
        """How many wait that have come before."""
        waiting, now = self._of(key), self._clock()
        for name in [name for name, one in waiting.items() if now - one.asked > _PATIENCE_S]:
            del waiting[name]
        before = 0
        for name, one in waiting.items():
            if name == owner:
                break
            before += one.times > 1
        return before

    def wait(self, key: bytes, owner: bytes) -> None:
        """Somebody was told to ask again."""
        waiting = self._waiting.setdefault(key, OrderedDict())
        known = waiting.get(owner)
        if known is not None:
            known.asked, known.times = self._clock(), known.times + 1
        elif len(waiting) < _MAX_WAITING:
            waiting[owner] = _Waiting(self._clock())

    def leave(self, key: bytes, owner: bytes) -> None:
        """Somebody has been let in."""
        waiting = self._of(key)
        waiting.pop(owner, None)
        if not waiting:
            self._waiting.pop(key, None)

    def _of(self, key: bytes) -> OrderedDict[bytes, _Waiting]:
        return self._waiting.get(key, OrderedDict())
