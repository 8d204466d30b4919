"""An attribute that is read after each step is watched, and then needs no request."""

from __future__ import annotations

import pytest

from envhub_sandbox.session.attribute_cache import AttributeCache
from envhub_sandbox.session.env_session import EnvSession
from tests.support.in_process.fake_lane import FakeLane, session_over


@pytest.fixture
def session() -> EnvSession:
    return session_over(FakeLane())


def stepped(session: EnvSession) -> None:
    session.counters.stepped(1)


def test_the_second_read_is_watched_and_the_third_is_free(session: EnvSession) -> None:
    cache = AttributeCache(session.lease)
    assert cache.get("task") is None
    assert not cache.should_watch("task")
    stepped(session)
    assert cache.should_watch("task")
    cache.put("task", ("a", "b"), watched=True)
    assert cache.get("task") is None
    stepped(session)
    assert cache.get("task") == ("a", "b")
    assert cache.get("task") is None


def test_what_is_not_watched_is_not_asked_for_again(session: EnvSession) -> None:
    """The runners say so, or its values can change without them: a list."""
    cache = AttributeCache(session.lease)
    for values, watched in [(("a", "b"), False), (([], []), True)]:
        name = str(watched)
        for _ in range(2):
            cache.should_watch(name)
            stepped(session)
        assert cache.should_watch(name)
        cache.put(name, values, watched=watched)
        stepped(session)
        assert cache.get(name) is None
        assert not cache.should_watch(name)
