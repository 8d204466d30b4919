"""Reads TOML within bounds, since a stranger may have written it."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_MAX_DOTS = 2000
"""Dots outside of texts: a parser's time grows with the square of the parts of a key."""
_TEXT = re.compile(r"\"(?:[^\"\\\n]|\\.)*\"?|'[^'\n]*'?")
"""Also texts without an end, which no document has: else the search begins anew at each quote."""
_TIME = re.compile(r":\d\d\.\d")


def loads(text: str, most: int, *, generated: bool = False) -> dict[str, Any]:
    """Parses a document of at most ``most`` characters; ``ValueError`` if invalid or too long.

    A ``generated`` document has no texts of several lines, and dots in its texts do not count.
    """
    if len(text) > most:
        raise ValueError(f"it has {len(text)} characters; at most {most} are read")
    counted = text
    if generated:
        # a text of several lines could hide dots from this count
        if '"""' in text or "'''" in text:
            raise ValueError("it has a text of several lines")
        counted = _TIME.sub("", _TEXT.sub("", text))
    if counted.count(".") > _MAX_DOTS:
        raise ValueError(f"it is too long: it has more than {_MAX_DOTS} dots")
    try:
        document: dict[str, Any] = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(str(error)[:200]) from error
    return document


def table(given: object, *names: str) -> Mapping[str, Any]:
    """Returns a table within tables; an empty table if there is none."""
    for name in names:
        given = given.get(name) if isinstance(given, dict) else None
    return given if isinstance(given, dict) else {}
