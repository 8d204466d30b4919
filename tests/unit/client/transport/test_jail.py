"""Values of attributes that are watched: known until a reply says that they have changed."""

from __future__ import annotations

from envhub_sandbox.transport.jail import WatchedAttributes
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from envhub_worker.protocol.messages.prefix import CHANGES

REPLY = m.pack(m.Value(1))


def test_what_has_changed_is_no_longer_known() -> None:
    """The others are, and the reply's own frames are as they were."""
    cache = WatchedAttributes()
    for name in ("task", "size"):
        assert cache.note(7, name, ("a", None))
    assert cache.take(CHANGES.put([(7, "task"), (8, "size")], REPLY)) == REPLY
    assert (cache.values(7, "task"), cache.values(7, "size")) == (None, ("a", None))


def test_what_can_change_without_a_word_is_not_kept() -> None:
    """Values of mutable types; and all of it where a reply had no room for changes."""
    cache = WatchedAttributes()
    assert not cache.note(7, "task", ("a", ["b"]))
    assert cache.values(7, "task") is None
    cache.note(7, "task", ("a", "b"))
    assert cache.take(REPLY * DEFAULT_LIMITS.frames) == REPLY * DEFAULT_LIMITS.frames
    assert cache.values(7, "task") is None
