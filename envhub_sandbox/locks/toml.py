"""TOML that somebody else may have written, read within bounds."""

from __future__ import annotations

import re
import sys
from typing import Any

from envhub_sandbox.errors import LockError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MAX_CHARACTERS = 16 * 1024 * 1024
MAX_DOTS = 2000
"""Outside of texts: the time that a parser takes grows with the square of the parts of a key."""
_TEXT = re.compile(r"\"(?:[^\"\\\n]|\\.)*\"|'[^'\n]*'")
_TIME = re.compile(r":\d\d\.\d")


def loads(text: str, where: str) -> dict[str, Any]:
    """A document.

    Raises:
        LockError: It is none, or too long.
    """
    if len(text) > MAX_CHARACTERS:
        raise LockError(f"{where} has {len(text)} characters; at most {MAX_CHARACTERS} are read")
    # texts of several lines could hide what is none from this count; nothing here writes them
    if '"""' in text or "'''" in text:
        raise LockError(f"{where} has a text of several lines, which no lock file has")
    if _TIME.sub("", _TEXT.sub("", text)).count(".") > MAX_DOTS:
        raise LockError(f"{where} has more than {MAX_DOTS} dots outside of texts")
    try:
        document: dict[str, Any] = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, ValueError, RecursionError) as error:
        raise LockError(f"{where} is no TOML: {str(error)[:200]}") from error
    return document
