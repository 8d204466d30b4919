"""An error says whose it is, and where that runs: once, in its first line."""

import contextlib
from typing import Any
from unittest.mock import MagicMock, Mock

import pytest

from envhub_sandbox import errors
from envhub_sandbox.extras.several_workers.part_errors import name_in
from envhub_sandbox.session.lease import AttributeCache
from envhub_sandbox.session.use_lock import UseLock
from envhub_worker.protocol.lifecycle import State
from tests.attacks.client.lying_server import NUM_ENVS
from tests.support.in_process.fake_lane import FakeLane, session_over


@pytest.mark.parametrize(
    ("rows", "named"),
    [((1, 2), "sub-environment 1 of 2"), ((0, NUM_ENVS), "sub-environments 0 to 1 of 2")],
)
def test_the_first_line_names_the_rows_and_the_place(rows: tuple[int, int], named: str) -> None:
    """What follows it, and further arguments, stay; a second naming adds nothing."""
    part = session_over(FakeLane(rows[1] - rows[0]), rows)
    error = errors.WorkerDiedError("it has ended\nits last words")
    error.args = (*error.args, "more")
    for _ in range(2):
        name_in(part, error)
        assert error.args == (f"it has ended ({named}, on here)\nits last words", "more")
    assert part.rows == rows
    name_in(session_over(FakeLane(1), (0, 1)), error)
    assert error.args[0].splitlines()[0].endswith("on here) (sub-environment 0 of 2, on here)")


def test_errors_of_others_keep_their_text() -> None:
    part = session_over(FakeLane(1), (0, 1))
    theirs = errors.remote_error("ValueError", "ValueError", "size")
    assert isinstance(theirs, errors.RemoteEnvError)
    bare = errors.WorkerDiedError("")
    bare.args = ()
    for error in (theirs, errors.LocalProtocolError("a lambda cannot be sent"), bare):
        before = error.args
        name_in(part, error)
        assert error.args == before


@pytest.mark.parametrize("lie", [{}, {"files": -1}, {"threads": 1.5}, {"processes": 1 << 63}])
def test_only_counts_are_taken_for_usage(lie: dict[str, object]) -> None:
    """A server says what a jail uses, and it may be anybody's."""
    true = {"processes": 1, "threads": 2, "files": 3, "memory_bytes": 4}
    session = session_over(FakeLane(1))
    session.lease = Mock(status=lambda: {**true, **lie, "more": "words"})
    assert session.usage() == ({} if lie else true)


# --- An attribute that is read after each step is watched, and then needs no request


def test_the_second_read_is_watched_and_the_third_is_free() -> None:
    """Once a step: a second read in the same step is a request."""
    session = session_over(FakeLane())
    cache = AttributeCache([session.lease], [(0, 2)])
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
    cache = AttributeCache([session.lease], [(0, 2)])
    for _ in range(2):
        cache.should_watch("name")
        session.counters.stepped(1)
    assert cache.should_watch("name")
    cache.put("name", values, watched=watched)
    session.counters.stepped(1)
    assert cache.get("name") is None
    assert not cache.should_watch("name")


# --- One use of an environment at a time, and what is done where a close or a lie came meanwhile


@pytest.fixture
def lease() -> Any:
    made = MagicMock()
    made.repository.named = contextlib.nullcontext
    made.lifecycle.state, made.lifecycle.closed = State.READY, False
    return made


def closed(lease: Any, fails: BaseException) -> BaseException:
    lease.lifecycle.state, lease.lifecycle.closed = State.CLOSED, True
    return fails


@pytest.mark.parametrize(
    ("fails", "told"),
    [
        (OSError("the socket is gone"), errors.WorkerDiedError),
        (errors.WorkerDiedError("closed"), errors.WorkerDiedError),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ],
)
def test_a_close_in_its_midst_is_finished_and_told(
    lease: Any, fails: BaseException, told: type[BaseException]
) -> None:
    """What is left is given back once, and a Ctrl-C stays one; so without an error."""
    with pytest.raises(told) as caught, UseLock(lease, MagicMock()).hold("step"):
        raise closed(lease, fails)
    assert isinstance(caught.value, type(fails)) or caught.value.__cause__ is fails
    with UseLock(lease, MagicMock()).hold("step"):
        pass
    assert lease.let_go.call_count == 2


@pytest.mark.parametrize(
    ("fails", "state", "told", "ends"),
    [
        (TypeError("unhashable"), State.READY, errors.RemoteProtocolError, True),
        (errors.RemoteProtocolError("a lie"), State.READY, errors.RemoteProtocolError, True),
        (errors.ActionError("the caller's"), State.READY, errors.ActionError, False),
        (TypeError("dealt with"), State.LATE, TypeError, False),
    ],
)
def test_a_worker_whose_replies_break_a_rule_is_given_up(
    lease: Any, fails: Exception, state: State, told: type[Exception], ends: bool
) -> None:
    """Whatever the handling of them raised; errors of the caller's, and old ones, end nothing."""
    failures = MagicMock()
    lease.lifecycle.state = state
    with pytest.raises(told), UseLock(lease, failures).judging("step"):
        raise fails
    assert failures.dead.called == ends
