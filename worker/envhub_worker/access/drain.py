"""A server that is about to end: nothing new comes in, and what runs has some time left."""

from __future__ import annotations

import time
from collections.abc import Callable

from envhub_worker.access.audit.log import Log
from envhub_worker.access.quotas import RETRY_S, BusyError
from envhub_worker.protocol.messages.server import DRAINING, Busy

_QUIET_S = 1.0
"""Between the end of the last jail and the server's own: its client learns why from this one."""


class Drain:
    """When a server was asked to end, and what that means for its clients.
    ``drain_s``: how long what runs may go on; 0 waits for nothing.
    """

    def __init__(self, drain_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._drain_s = drain_s
        self._clock = clock
        self._until: float | None = None
        self._quiet_since: float | None = None

    @property
    def begun(self) -> bool:
        """Whether nothing new is let in."""
        return self._until is not None

    @property
    def over(self) -> bool:
        """Whether the time of what runs is up."""
        return self._until is not None and self._clock() >= self._until

    @property
    def left_s(self) -> float | None:
        """How long what runs may go on; None before it begins."""
        return None if self._until is None else max(0.0, self._until - self._clock())

    def begin(self, log: Log) -> bool:
        """Let nothing new in; False if there is no time to give, or it was said before."""
        if not self._drain_s or self._until is not None:
            return False
        self._until = self._clock() + self._drain_s
        log.say("draining", "info", seconds=self._drain_s)
        return True

    def quiet(self, busy: bool) -> bool:
        """Whether no jail has been open for a moment; ``busy``: one is."""
        now = self._clock()
        if busy or self._quiet_since is None:
            self._quiet_since = None if busy else now
            return False
        return now - self._quiet_since >= _QUIET_S

    def refuse_new(self) -> None:
        """Raise ``BusyError`` once it has begun."""
        if self._until is not None:
            raise BusyError(
                Busy(DRAINING, 0, 0, RETRY_S),
                "the server drains and accepts nothing new: try again when its replacement runs",
            )
