"""Removes logins from URLs such as ``https://user:password@hub.example``, to send as a header.

Every library shows, logs and raises the URLs that it gets. So the login is removed from the URL at
once, and no pickle, repr, crash bundle, log or error ever contains it.
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
    """The user and password of a URL, or None."""
    match = _LOGIN.search(url)
    if match is None:
        return None
    user, _, password = match.group()[:-1].partition(":")
    return unquote(user), unquote(password)


def authorization(login: tuple[str, str]) -> str:
    """The value of the ``Authorization`` header for a login (HTTP Basic)."""
    return "Basic " + base64.b64encode(":".join(login).encode()).decode()
