"""One event as one line: for people, or as JSON for programs.

Trust: names and reasons come from clients, from jails and from strangers at the port. What they
hold is written in ASCII, with everything escaped that is no plain character, and cut where it is
long: nobody can end a line and begin one of his own, or reach the terminal that shows it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from datetime import datetime, timezone

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
    moment = datetime.fromtimestamp(when, timezone.utc)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{moment.microsecond // 1000:03d}Z"


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
