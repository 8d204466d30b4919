"""What a jail was denied, as its server remembers it: also after its death, until it is closed."""

from __future__ import annotations

import re

_DENIAL = re.compile(r"[a-z0-9_]{1,40}( [A-Z0-9_]{1,40}| /.{0,400})?")
_MOST = 64


def read_denials(said: object) -> tuple[str, ...] | None:
    """The texts that have the form of a denial; None where none are recorded.

    Trust: a server on another host may say anything, and paths are a stranger's words.
    """
    if not isinstance(said, tuple):
        return None
    texts = (one for one in said[:_MOST] if isinstance(one, str) and one.isprintable())
    return tuple(one for one in texts if _DENIAL.fullmatch(one))
