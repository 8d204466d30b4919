"""An attribute that is read after each step is watched, and then needs no request."""

from __future__ import annotations

from typing import Any

import pytest

from envhub_sandbox.session.attribute_cache import AttributeCache
from tests.support.in_process.fake_lane import FakeLane, session_over


def test_the_second_read_is_watched_and_the_third_is_free() -> None:
    """Once a step: a second read in the same step is a request."""
    session = session_over(FakeLane())
    cache = AttributeCache(session.lease)
    assert cache.get("task") is None
    assert not cache.should_watch("task")
    session.counters.stepped(1)
    assert cache.should_watch("task")
    cache.put("task", ("a", "b"), watched=True)
    assert cache.get("task") is None
    session.counters.stepped(1)
    assert cache.get("task") == ("a", "b")
    assert cache.get("task") is None


@pytest.mark.parametrize(("values", "watched"), [(("a", "b"), False), (([], []), True)])
def test_what_is_not_watched_is_not_asked_for_again(values: tuple[Any, ...], watched: bool) -> None:
    """The runners say so, or its values can change without them: a list."""
    session = session_over(FakeLane())
    cache = AttributeCache(session.lease)
    for _ in range(2):
        cache.should_watch("name")
        session.counters.stepped(1)
    assert cache.should_watch("name")
    cache.put("name", values, watched=watched)
    session.counters.stepped(1)
    assert cache.get("name") is None
    assert not cache.should_watch("name")
