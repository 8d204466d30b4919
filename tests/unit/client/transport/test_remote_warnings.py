"""What a client makes of warnings: Python's own, once each, bounded, where the caller stands."""

from __future__ import annotations

import copy
import pickle
import warnings
from typing import Any

import pytest

from envhub_sandbox.errors import RemoteEnvWarning
from envhub_sandbox.transport.remote_warnings import MOST, RemoteWarnings
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.messages.prefix import WARNINGS

REPLY = m.pack(m.Value(1))


def told(heard: RemoteWarnings, *some: tuple[str, str]) -> list[Any]:
    """What the caller is told after a reply with these."""
    if some:
        assert heard.take(WARNINGS.put(some, REPLY)) == REPLY
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        heard.show("a/b@c")
    return shown


def test_each_is_told_once() -> None:
    """Whichever process has said it, and however often; at the caller's line, and never painted."""
    heard = RemoteWarnings()
    assert heard.take(REPLY) is REPLY
    [one, other] = told(heard, ("UserWarning", "slow"), ("x.Own", "slow"), ("x.Own", "slow"))
    assert str(one.message) == "a/b@c: UserWarning: slow"
    assert str(other.message) == "a/b@c: x.Own: slow"
    assert one.category is other.category is RemoteEnvWarning
    assert one.filename == __file__, "Python's filters go by that"
    assert told(heard, ("UserWarning", "slow")) == []
    [painting] = told(heard, ("\x1b]0;owned\x07\n", "\x1b[2J\r\u202eslow"))
    assert str(painting.message).isprintable()
    for twin in (copy.copy(one.message), pickle.loads(pickle.dumps(one.message))):
        found = (str(twin), twin.label, twin.category, twin.text)
        assert found == (str(one.message), "a/b@c", "UserWarning", "slow")


def test_a_flood_ends_with_a_word() -> None:
    """Who has more than so many different ones is not listened to any more."""
    heard, shown = RemoteWarnings(), []
    for number in range(3 * MOST):
        shown += told(heard, ("UserWarning", str(number)))
    assert len(shown) == MOST + 1
    assert "more than" in str(shown[-1].message)


def test_what_the_filters_raise_leaves_the_rest() -> None:
    """As an error it comes out; what follows is told the next time."""
    heard = RemoteWarnings()
    heard.take(WARNINGS.put([("UserWarning", "one"), ("UserWarning", "two")], REPLY))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(RemoteEnvWarning, match="one"):
            heard.show("a/b@c")
    [two] = told(heard)
    assert two.message.text == "two"
