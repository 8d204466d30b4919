"""TOML that a stranger may have written, read within bounds."""

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
"""Outside of texts: the time that a parser takes grows with the square of the parts of a key."""
_TEXT = re.compile(r"\"(?:[^\"\\\n]|\\.)*\"|'[^'\n]*'")
_TIME = re.compile(r":\d\d\.\d")


def loads(text: str, most: int, *, generated: bool = False) -> dict[str, Any]:
    """A document of at most so many characters; ``ValueError`` if it is none, or too long.

    One that is ``generated`` has no texts of several lines, and dots in its texts do not count.
    """
    if len(text) > most:
        raise ValueError(f"it has {len(text)} characters; at most {most} are read")
    counted = text
    if generated:
        # texts of several lines could hide what is none from this count
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
    """A table within tables; an empty one where there is none."""
    for name in names:
        given = given.get(name) if isinstance(given, dict) else None
    return given if isinstance(given, dict) else {}
