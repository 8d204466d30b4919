"""Sessions of clients: which jails they hold."""

from __future__ import annotations

from envhub_worker.server.sessions import CONNECTIONS_OF_ONE, Sessions


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
    assert session.held is not None
    assert set(session.held) == {1, 2}
    assert not sessions.unheld(session, 1, 120.0)
    assert sessions.unheld(session, 2, 120.0)


def test_a_session_has_so_many_connections() -> None:
    """Each is memory of the server; the one that was unused for longest is forgotten."""
    sessions = Sessions()
    for number in range(CONNECTIONS_OF_ONE + 1):
        session = sessions.connect(b"%d" % number, b"key", b"name")
        assert sessions.find(b"0", b"key") is session
    assert len(session.connections) == CONNECTIONS_OF_ONE
    assert sessions.find(b"1", b"key") is None
    sessions.drop(session)
    assert sessions.find(b"0", b"key") is None, "who is still connected has to say Hello again"
