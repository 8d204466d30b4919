"""A log that cannot be filled: some lines a minute of each event, then a count.

Strangers share a few lines, so that noise at the port leaves room for what an operator needs. Each
client has many of its own, which ordinary work does not reach.

One event is one line: for people, or as JSON for programs. Trust: names and reasons come from
clients, from jails and from strangers at the port. What they hold is written in ASCII, with
everything escaped that is no plain character, and cut where it is long: a sender can neither end a
line and begin one of its own, nor reach the terminal that shows it.
"""

from __future__ import annotations

import contextlib
import json
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping
from datetime import datetime, timezone

LINES = 10
"""Of an event that no key stands behind."""
CLIENT_LINES = 600
"""Of an event of one client."""
PERIOD_S = 60.0
LEVELS = ("debug", "info", "warning", "error")
"""The least important first."""
MAX_TEXT = 300
"""Characters of a value."""
MAX_LONG_TEXT = 8_000
"""Characters of a traceback, which is our own code's."""
_LONG = frozenset({"traceback"})
_PLAIN = re.compile(r"[A-Za-z0-9_.:/@+-]+")

Fields = Mapping[str, object]
Form = Callable[[float, str, str, Fields], str]
"""Makes a line of the time, the level, the event and what else there is to say of it."""


def text_line(when: float, level: str, event: str, fields: Fields) -> str:
    """``2026-01-31T12:00:00.000Z info jail_opened client=alice ...``"""
    words = [f"{name}={_word(_bounded(name, value))}" for name, value in fields.items()]
    return " ".join([_time(when), level, event, *words])


def json_line(when: float, level: str, event: str, fields: Fields) -> str:
    """An object with ``time``, ``level``, ``event`` and the fields, which have other names."""
    said = {name: _bounded(name, value) for name, value in fields.items()}
    return json.dumps({"time": _time(when), "level": level, "event": event, **said})


FORMS: dict[str, Form] = {"text": text_line, "json": json_line}


def _time(when: float) -> str:
    moment = datetime.fromtimestamp(when, timezone.utc).replace(tzinfo=None)
    return f"{moment.isoformat(timespec='milliseconds')}Z"


def _bounded(name: str, value: object) -> bool | int | float | str:
    """A number, or text that is not too long."""
    if isinstance(value, float):
        return round(value, 3)
    if isinstance(value, (bool, int)):
        return value
    text, limit = str(value), MAX_LONG_TEXT if name in _LONG else MAX_TEXT
    if len(text) <= limit:
        return text
    return f"{text[:limit]}[... {len(text) - limit} characters left out]"


def _word(value: bool | int | float | str) -> str:
    if isinstance(value, str) and _PLAIN.fullmatch(value):
        return value
    return json.dumps(value)  # ASCII alone: quotes, control characters and the like are escaped


def _to_stderr(line: str) -> None:
    # closed, or a pipe without a reader: no reason to end what is served
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
