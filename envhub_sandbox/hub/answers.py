"""What a Hub's answers may be before anything is done with them: bounded, and harmless as names.

huggingface_hub makes paths of the headers ``ETag`` and ``X-Repo-Commit``: a Hub that lies in them
would write files outside of the Hub cache. Sessions are those of requests (before 1.0) or httpx.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

MAX_BODY_BYTES = 64 << 20
"""Of a page of a listing, unpacked: those of the Hub have some 300 kB."""
_MAX_BODY_S = 300.0
_NAMES = {
    "ETag": re.compile(r'(W/)?"?[A-Za-z0-9_+=:-][A-Za-z0-9_+=:.-]{0,199}"?'),
    "X-Linked-ETag": re.compile(r'(W/)?"?[A-Za-z0-9_+=:-][A-Za-z0-9_+=:.-]{0,199}"?'),
    "X-Repo-Commit": re.compile(r"[0-9a-f]{40}"),
    "X-Xet-Hash": re.compile(r"[0-9a-f]{1,128}"),
}


class HostileAnswerError(Exception):
    """An answer that no Hub gives; the text says what is wrong with it."""


@contextmanager
def streamed(session: Any, url: str, options: Mapping[str, Any]) -> Iterator[Any]:
    """The answer to a GET, before its body is read."""
    if callable(getattr(session, "stream", None)):  # httpx; of requests it is a bool
        with session.stream("GET", url, **options) as response:
            yield response
    else:
        with session.get(url, stream=True, **options) as response:
            yield response


def bounded_body(response: Any) -> bytes:
    """The body of a streamed answer, unpacked. Raises ``HostileAnswerError``."""
    of_requests = hasattr(response, "iter_content")
    chunks = response.iter_content(1 << 16) if of_requests else response.iter_bytes()
    body, end = bytearray(), time.monotonic() + _MAX_BODY_S
    for chunk in chunks:
        body += chunk
        if len(body) > MAX_BODY_BYTES:
            raise HostileAnswerError(f"an answer has over {MAX_BODY_BYTES} bytes")
        if time.monotonic() > end:
            raise HostileAnswerError(f"an answer has not ended after {_MAX_BODY_S:.0f} s")
    return bytes(body)


@contextmanager
def guarded(session: Any) -> Iterator[None]:
    """While this lasts, the session takes no answer whose headers make hostile names.

    Others may use the session meanwhile, and their answers are judged, too.
    """
    hooks = getattr(session, "event_hooks", None)
    if hooks is None:
        hooks = session.hooks
        before = list(hooks.get("response", ()))
        hooks["response"] = [*before, _judge]
        try:
            yield
        finally:
            hooks["response"] = before
        return
    hooks["response"].append(_judge)
    try:
        yield
    finally:
        hooks["response"].remove(_judge)


def _judge(response: Any, *_: object, **__: object) -> None:
    for name, form in _NAMES.items():
        value = response.headers.get(name)
        if value is not None and not form.fullmatch(value):
            raise HostileAnswerError(f"the header {name} of an answer is {value[:200]!r}")
