"""A log that strangers cannot fill: a few lines a minute, then a count."""

from __future__ import annotations

import contextlib
import sys
import time
from collections import Counter
from collections.abc import Callable

LINES = 10
PERIOD_S = 60.0


def _to_stderr(line: str) -> None:
    # closed, or a pipe that nobody reads any more: no reason to end what is served
    with contextlib.suppress(OSError, ValueError):
        print(line, file=sys.stderr, flush=True)


class Log:
    """Writes at most ``LINES`` lines of a kind in ``PERIOD_S`` seconds."""

    def __init__(
        self,
        write: Callable[[str], None] = _to_stderr,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._write = write
        self._clock = clock
        self._since = clock()
        self._counts: Counter[str] = Counter()

    def say(self, kind: str, text: str) -> None:
        """Write a line, or count it."""
        self.tick()
        self._counts[kind] += 1
        if self._counts[kind] <= LINES:
            self._write(f"envhub-worker: {kind}: {text}")

    def tick(self) -> None:
        """When a period is over, say how much was left out."""
        if self._clock() - self._since < PERIOD_S:
            return
        for kind, count in self._counts.items():
            if count > LINES:
                self._write(f"envhub-worker: {kind}: and {count - LINES} more in a minute")
        self._counts.clear()
        self._since = self._clock()
