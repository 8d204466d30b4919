"""One jail for all environments of a repository: opened by the first, ended with the last."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

from envhub_sandbox.session.jails.builder import JailSource, SharedJail
from envhub_sandbox.transport.deadline import Deadline


class _Loaded(SimpleNamespace):
    """A connection to the jail number 7; by identity."""

    __hash__ = object.__hash__
    __eq__ = object.__eq__


def loaded() -> Any:
    return _Loaded(jail=MagicMock(number=7))


@pytest.fixture
def launcher() -> Any:
    return MagicMock(open=MagicMock(side_effect=lambda *_: loaded()), connect=lambda *_: loaded())


def test_it_is_opened_once_and_ends_with_its_last_user(launcher: Any) -> None:
    source = SharedJail(launcher, lambda: None)
    users = [source.take(Deadline(None)) for _ in range(3)]
    assert launcher.open.call_count == 1
    for user in users:
        assert not launcher.close.called
        source.give_back(user)
    assert launcher.close.call_count == 1
    source.take(Deadline(None))
    assert launcher.open.call_count == 2


def test_one_that_was_provided_and_never_taken_is_ended(launcher: Any) -> None:
    """By the close of its suite, once; while somebody uses it that ends nothing."""
    source = SharedJail(launcher, lambda: None)
    source.provide(loaded())
    user = source.take(Deadline(None))
    assert not launcher.open.called
    source.close()
    assert not launcher.close.called
    source.give_back(user)
    source.close()
    assert launcher.close.call_count == 1


def test_a_worker_that_is_given_up_is_given_up_for_all(launcher: Any) -> None:
    """They share its process; a jail of one's own is nobody else's."""
    source = SharedJail(launcher, lambda: None)
    one, _ = source.take(Deadline(None)), source.take(Deadline(None))
    source.end(one)
    assert (launcher.interrupt.call_count, launcher.close.call_count) == (1, 1)
    own = JailSource(launcher, lambda: None)
    assert own.take(Deadline(None)) is not own.take(Deadline(None))
