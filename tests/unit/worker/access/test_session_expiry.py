"""Sessions that nothing holds any more, and jails whose client let go of them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

from envhub_worker.access.session_expiry import SessionExpiry, longest_gone
from envhub_worker.access.sessions import Sessions


class _Jails:
    """The jails of each owner."""

    def __init__(self, **of: int) -> None:
        self.of = {owner.encode(): SimpleNamespace(number=number) for owner, number in of.items()}
        self.ended: list[tuple[int, str]] = []

    def open_ones(self, owner: bytes) -> list[Any]:
        return [self.of[owner]] if owner in self.of else []

    def end(self, entry: Any, why: str) -> None:
        self.ended.append((entry.number, why))
        self.of = {owner: one for owner, one in self.of.items() if one is not entry}


@pytest.mark.parametrize(("idle_s", "ended"), [(120, [7]), (0, [])])
def test_a_client_that_is_not_heard_of_loses_its_jails(idle_s: int, ended: list[int]) -> None:
    """After the time that the operator has set, if he has; the other one is heard."""
    now = [0.0]
    sessions, jails, uploads = Sessions(lambda: now[0]), _Jails(keya=7, keyb=8), MagicMock()
    sessions.connect(b"1", b"key", b"a")
    expiry = SessionExpiry(idle_s, uploads, MagicMock(), lambda: None)
    now[0] = 200.0
    sessions.connect(b"2", b"key", b"b")
    expiry.tick(sessions, jails)  # type: ignore[arg-type]
    assert [number for number, _ in jails.ended] == ended
    assert [one.name for one in sessions.all()] == [b"b"] if ended else [b"a", b"b"]
    assert uploads.forget.called == bool(ended)


def test_a_session_without_connections_and_jails_is_forgotten() -> None:
    sessions, jails = Sessions(), _Jails(keyb=8)
    for number, name in enumerate((b"a", b"b", b"c"), start=1):
        sessions.connect(b"id%d" % number, b"key", name, number)
    SessionExpiry(120, MagicMock(), MagicMock(), lambda: frozenset({3})).tick(sessions, jails)  # type: ignore[arg-type]
    assert [one.name for one in sessions.all()] == [b"b", b"c"]
    assert jails.ended == []
    gone = longest_gone(sessions.all())
    assert gone is not None
    assert gone.name == b"b"
    assert longest_gone([]) is None
