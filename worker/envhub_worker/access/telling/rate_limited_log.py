"""A log that nobody can fill: some lines a minute of each event, then a count.

Strangers share a few lines, so that noise at the port leaves room for what an operator needs. Each
client has many of its own, which ordinary work does not reach.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections import Counter
from collections.abc import Callable

from envhub_worker.access.telling.log_lines import LEVELS, Form, text_line

LINES = 10
"""Of an event that nobody's key stands behind."""
CLIENT_LINES = 600
"""Of an event of one client."""
PERIOD_S = 60.0


def _to_stderr(line: str) -> None:
    # closed, or a pipe that nobody reads any more: no reason to end what is served
    with contextlib.suppress(OSError, ValueError):
        print(line, file=sys.stderr, flush=True)


class Log:
    """Writes at most so many lines of an event in ``PERIOD_S`` seconds."""

    def __init__(
        self,
        write: Callable[[str], None] = _to_stderr,
        clock: Callable[[], float] = time.monotonic,
        form: Form = text_line,
        level: str = "info",
    ) -> None:
        self._write = write
        self._clock = clock
        self._form = form
        self._least = LEVELS.index(level)
        self._since = clock()
        self._counts: Counter[tuple[str, str]] = Counter()

    def say(self, event: str, level: str = "warning", *, whose: str = "", **fields: object) -> None:
        """Write a line, or count it. ``whose`` is the client's key; empty for a stranger's."""
        if LEVELS.index(level) < self._least:
            return
        self.tick()
        self._counts[event, whose] += 1
        if self._counts[event, whose] <= _most(whose):
            self._line(level, event, **fields)

    def tick(self) -> None:
        """When a period is over, say how much was left out."""
        if self._clock() - self._since < PERIOD_S:
            return
        for (event, whose), count in self._counts.items():
            if count > _most(whose):
                key = {"key": whose[:16]} if whose else {}
                self._line("warning", "left_out", of=event, lines=count - _most(whose), **key)
        self._counts.clear()
        self._since = self._clock()

    def _line(self, level: str, event: str, **fields: object) -> None:
        self._write(self._form(time.time(), level, event, fields))


def _most(whose: str) -> int:
    return CLIENT_LINES if whose else LINES
