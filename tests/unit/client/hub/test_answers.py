"""Answers of a Hub are bounded, and their headers make no hostile names."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from envhub_sandbox.hub import answers
from envhub_sandbox.hub.answers import HostileAnswerError, bounded_body, guarded


def sessions() -> list[tuple[Any, list[Any]]]:
    """One of httpx and one of requests, with the hooks that each calls with an answer."""
    of_httpx = SimpleNamespace(event_hooks={"response": []})
    of_requests = SimpleNamespace(hooks={"response": []})
    return [(of_httpx, of_httpx.event_hooks), (of_requests, of_requests.hooks)]


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("ETag", '"0123abc"', '"../../etc/x"'),
        ("X-Linked-ETag", 'W/"0123abc"', "a/b"),
        ("X-Repo-Commit", "0" * 40, "../" * 10),
        ("X-Xet-Hash", "0a", "."),
    ],
)
def test_headers_that_would_lead_elsewhere_are_refused(name: str, good: str, bad: str) -> None:
    """While a session is guarded, and no longer; honest ones pass."""
    for session, hooks in sessions():
        with guarded(session):
            [judge] = hooks["response"]
            judge(SimpleNamespace(headers={name: good}))
            with pytest.raises(HostileAnswerError, match=name):
                judge(SimpleNamespace(headers={name: bad}))
        assert hooks["response"] == []


def test_a_body_is_read_to_its_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(answers, "MAX_BODY_BYTES", 10)
    read: list[int] = []

    def chunks() -> Any:
        for number in range(10**6):
            read.append(number)
            yield b"123"

    assert bounded_body(SimpleNamespace(iter_bytes=lambda: [b"12345", b"67890"])) == b"1234567890"
    with pytest.raises(HostileAnswerError, match="over 10 bytes"):
        bounded_body(SimpleNamespace(iter_content=lambda size: chunks()))
    assert len(read) == 4
