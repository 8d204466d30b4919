"""Sessions, and places on a server: who holds what, who waits, whose place ends, and a drain."""

from collections.abc import Iterator
from itertools import count, repeat
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

from envhub_worker.extras.access.places import Drain, Line, Places, longest_gone
from envhub_worker.extras.access.quotas import Quotas
from envhub_worker.server.sessions import CONNECTIONS_OF_ONE, Sessions


def test_who_has_asked_twice_stands_before_who_comes_later() -> None:
    line = Line(lambda: 0.0)
    line.wait(b"key", b"first")
    assert (line.waiting, line.ahead(b"key", b"second")) == (0, 0)
    line.wait(b"key", b"first")
    line.wait(b"key", b"second")
    assert (line.waiting, line.ahead(b"key", b"second")) == (1, 1)
    assert line.ahead(b"key", b"first") == line.ahead(b"another key", b"second") == 0
    line.leave(b"key", b"first")
    assert (line.waiting, line.ahead(b"key", b"second")) == (0, 0)


def test_who_asks_no_more_is_forgotten() -> None:
    now = [0.0]
    line = Line(lambda: now[0])
    for _ in range(2):
        line.wait(b"key", b"gone")
    now[0] = 6.0
    assert (line.waiting, line.ahead(b"key", b"other")) == (0, 0)
    for number in range(5_000):
        line.wait(b"crowd", str(number).encode())
        line.wait(b"crowd", str(number).encode())
    assert line.waiting == 1024


class _Jails:
    """The jails of each owner."""

    def __init__(self, **of: int) -> None:
        self.of = {owner.encode(): SimpleNamespace(number=number) for owner, number in of.items()}
        self.ended: list[tuple[int, str]] = []

    def open_ones(self, owner: bytes) -> list[Any]:
        return [self.of[owner]] if owner in self.of else []

    def end(self, entry: Any, why: str) -> None:
        if entry not in self.of.values():
            return
        self.ended.append((entry.number, why))
        self.of = {owner: one for owner, one in self.of.items() if one is not entry}


def places(idle_s: int, sessions: Sessions, jails: Any, uploads: Any, wires: Any) -> Places:
    return Places(Quotas(), idle_s, sessions, jails, uploads, MagicMock(), lambda: wires)


@pytest.mark.parametrize(("idle_s", "ended"), [(120, [7]), (0, [])])
def test_a_client_that_is_not_heard_of_loses_its_jails(idle_s: int, ended: list[int]) -> None:
    """After the time that the operator has set, if he has; the other one is heard."""
    now = [0.0]
    sessions, jails, uploads = Sessions(lambda: now[0]), _Jails(keya=7, keyb=8), MagicMock()
    sessions.connect(b"1", b"key", b"a")
    now[0] = 200.0
    sessions.connect(b"2", b"key", b"b")
    places(idle_s, sessions, jails, uploads, frozenset()).tick()
    assert [number for number, _ in jails.ended] == ended
    assert [one.name for one in sessions.all()] == [b"b"] if ended else [b"a", b"b"]
    assert uploads.forget.called == bool(ended)


@pytest.mark.parametrize("idle_s", range(1, 9))
def test_a_client_that_fell_silent_gave_nothing_up(idle_s: int) -> None:
    times: Iterator[int] = repeat(0)
    sessions, jails = Sessions(lambda: next(times)), _Jails(keya=7)
    session = sessions.connect(b"1", b"key", b"a")
    sessions.keep(session, (7,))
    times = count(1)
    for _ in range(10):
        places(idle_s, sessions, jails, MagicMock(), frozenset()).tick()
    assert jails.ended == [(7, f"its client has sent nothing for {idle_s} s")]


def test_a_session_without_connections_and_jails_is_forgotten() -> None:
    sessions, jails = Sessions(), _Jails(keyb=8)
    for number, name in enumerate((b"a", b"b", b"c"), start=1):
        sessions.connect(b"id%d" % number, b"key", name, number)
    places(120, sessions, jails, MagicMock(), frozenset({3})).tick()
    assert [one.name for one in sessions.all()] == [b"b", b"c"]
    assert jails.ended == []
    assert longest_gone(sessions.all()).name == b"b"
    assert longest_gone([]) is None


def test_the_last_client_has_a_moment_to_hear_why() -> None:
    now = [0.0]
    drain = Drain(60.0, lambda: now[0])
    for busy, at, quiet in (
        *((False, 0.0, False), (False, 0.9, False), (True, 1.0, False)),
        *((False, 1.1, False), (False, 2.0, False), (False, 2.1, True)),
    ):
        now[0] = at
        assert drain.quiet(busy) is quiet


def test_a_jail_that_is_used_is_held_though_its_client_no_longer_says_so() -> None:
    """The thread that says so may have ended; one that is not used is given up."""
    now = [0.0]
    sessions = Sessions(lambda: now[0])
    session = sessions.connect(b"id", b"key", b"name")
    sessions.keep(session, (1, 2))
    for now[0] in (100.0, 200.0, 300.0):
        sessions.used(b"id", b"key", 1)
        sessions.used(b"id", b"key", 7)  # which the server does not know
        sessions.used(b"id", b"another", 2)
    assert set(session.held) == {1, 2}
    assert not sessions.unheld(session, 1, 120.0)
    assert sessions.unheld(session, 2, 120.0)


def test_a_session_has_so_many_connections() -> None:
    sessions = Sessions()
    for number in range(CONNECTIONS_OF_ONE + 1):
        session = sessions.connect(b"%d" % number, b"key", b"name")
        assert sessions.find(b"0", b"key") is session
    assert len(session.connections) == CONNECTIONS_OF_ONE
    assert sessions.find(b"1", b"key") is None
    sessions.drop(session)
    assert sessions.find(b"0", b"key") is None, "who is still connected has to say Hello again"
