"""A suite's hold on its server: from the first jail to the last environment."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

from envhub_sandbox.sandboxes.pool import ServerHold, ServerPool, ServerUse
from envhub_sandbox.session.jails.builder import JailSource, SharedJail
from envhub_sandbox.transport.deadline import Deadline
from tests.unit.client.sandboxes.test_pool import Server


@pytest.fixture
def use() -> Callable[[], ServerUse[Server]]:
    """Gives a use of the one server; a fresh one where it has died."""
    pool: ServerPool[Server] = ServerPool()
    return partial(pool.acquire, "key", Server)


@pytest.fixture
def events() -> list[str]:
    return []


@pytest.fixture
def hold(use: Callable[[], ServerUse[Server]], events: list[str]) -> ServerHold:
    return ServerHold(use, lambda: events.append("enter"), lambda: events.append("empty"))


def test_it_lasts_from_the_first_jail_to_the_last_environment(
    hold: ServerHold, use: Callable[[], ServerUse[Server]], events: list[str]
) -> None:
    """However many jails come and go in between; to leave twice is to leave once."""
    leave_one, leave_two = hold.enter(), hold.enter()
    taken = use()
    server = taken.server
    for _ in range(3):
        hold.keep(server)
    taken.release()
    assert taken.users() == 1
    for _ in range(2):
        leave_one()
    assert not server.ends
    assert events == ["enter"] * 2
    leave_two()
    assert server.ends
    assert events == ["enter"] * 2 + ["empty"]
    hold.keep(server)  # there is no environment that could need it
    assert taken.users() == 0


def test_it_moves_on_from_a_server_that_has_died(
    hold: ServerHold, use: Callable[[], ServerUse[Server]]
) -> None:
    leave = hold.enter()
    dead = use()
    hold.keep(dead.server)
    dead.release()
    dead.server.runs = False
    fresh = use()
    hold.keep(fresh.server)
    assert dead.server.ends
    assert fresh.users() == 2
    fresh.release()
    leave()
    assert fresh.server.ends


def test_an_interrupted_end_is_finished_by_the_next_leave(
    hold: ServerHold, use: Callable[[], ServerUse[Server]], events: list[str]
) -> None:
    """A Ctrl-C came while it waited for a jail that was still ending, and another at the server."""
    leave, further = hold.enter(), hold.enter()
    taken = use()
    server = taken.server
    hold.keep(server)
    taken.release()

    def interrupted() -> None:
        raise KeyboardInterrupt

    assert hold.close_later(server, interrupted)
    further()
    server.stop = interrupted  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        leave()
    del server.stop
    assert (server.ends, "empty" in events) == ([], False)
    leave()
    assert server.ends
    assert events[-1] == "empty"


def test_each_end_is_waited_for_once_by_the_next_or_the_last(
    hold: ServerHold, use: Callable[[], ServerUse[Server]]
) -> None:
    """Never more than one is left; one that the garbage collector adds meanwhile is not lost."""
    leave, further = hold.enter(), hold.enter()
    server = use().server
    waited: list[int] = []
    assert not hold.close_later(server, lambda: waited.append(-1))  # it is not kept
    taken = use()
    hold.keep(taken.server)
    for number in range(3):
        assert hold.close_later(taken.server, partial(waited.append, number))
        assert waited == list(range(number))
    assert hold.settle()
    assert waited == [0, 1, 2]
    assert not hold.settle()

    def collected() -> None:
        assert hold.close_later(taken.server, partial(waited.append, 4))
        waited.append(3)

    assert hold.close_later(taken.server, collected)
    assert hold.settle()
    assert waited == [0, 1, 2, 3, 4]
    further()
    assert not hold.close_later(taken.server, lambda: waited.append(-1))  # no other is to come
    leave()


# --- One jail for all environments of a repository: opened by the first, ended with the last


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
