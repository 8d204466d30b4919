"""Logins in URLs, as in ``https://user:password@hub.example``: sent as a header, never kept.

A URL is shown, logged and raised by every library that it passes through. So the login is taken
out of it at once, and no pickle, repr, crash bundle, log or error ever has it.
"""

from __future__ import annotations

import base64
import re
from urllib.parse import unquote

_LOGIN = re.compile(r"(?<=://)[^/?#]*@")


def without_login(url: str) -> str:
    """The URL without a user and password."""
    return _LOGIN.sub("", url)


def login_of(url: str) -> tuple[str, str] | None:
    """User and password of a URL, or None."""
    match = _LOGIN.search(url)
    if match is None:
        return None
    user, _, password = match.group()[:-1].partition(":")
    return unquote(user), unquote(password)


def authorization(login: tuple[str, str]) -> str:
    """The value of the header that a login is sent in, as HTTP clients make it of a URL."""
    return "Basic " + base64.b64encode(":".join(login).encode()).decode()
