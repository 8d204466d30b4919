"""The requests of one environment: their order, their errors, and what is shown beside them."""

import warnings
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError

from envhub_sandbox import errors
from envhub_sandbox.session.env_session import EnvSession
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import State
from tests.support.in_process.fake_lane import FakeLane, session_over

ACTIONS = np.zeros(2, np.int64)


@pytest.fixture
def lane() -> FakeLane:
    return FakeLane()


@pytest.fixture
def session(lane: FakeLane) -> EnvSession:
    return session_over(lane)


def render(number: int, bounds: tuple[int, int]) -> m.Message:
    return m.Render(number)


def recorded(session: EnvSession) -> list[m.Message]:
    return [*map(m.unpack, session.recorder.recording())]


def test_a_request_is_sent_counted_and_kept(session: EnvSession, lane: FakeLane) -> None:
    [reply] = session.requests.ask("render", render)
    assert reply == lane.answer
    assert lane.sent == [m.Render(lane.number)]
    assert session.counters.requests == 1
    assert recorded(session) == [m.Render(lane.number)]
    lane.answer = m.RaisedException("ValueError", "a.Oops", "no", "trace", "run")
    with pytest.raises(errors.RemoteEnvError, match="no"):
        session.requests.ask("render", render)
    assert session.lifecycle.state is State.READY


def test_what_is_sent_instead_is_not_what_is_kept(session: EnvSession, lane: FakeLane) -> None:
    """The history repeats the caller's request; what cannot be sent was not sent."""

    def unsendable(request: object) -> None:
        raise errors.LocalProtocolError("too large")

    send, lane.send = lane.send, unsendable
    with pytest.raises(errors.LocalProtocolError):
        session.requests.submit("render", render)
    lane.send = send
    assert session.counters.requests == 0
    session.requests.submit("call", render, lambda number, _: m.Watch(number, "name"))
    assert lane.sent == [m.Watch(lane.number, "name")]
    assert recorded(session) == [m.Render(lane.number)]


def test_a_wrong_message_gives_the_worker_up(session: EnvSession, lane: FakeLane) -> None:
    def ask() -> m.Message:
        return session.requests.ask_one("name", m.ITSELF, lambda *row: m.GetOne(*row, 0, "name"))

    for lane.answer in (m.Value(1), m.Method()):
        assert ask() == lane.answer
    lane.answer = m.ResetDone(0, {})
    with pytest.raises(errors.RemoteProtocolError, match="ResetDone instead of Value or Method"):
        ask()
    assert session.lifecycle.state is State.DEAD
    with pytest.raises(errors.WorkerDiedError, match="cannot render"):
        session.requests.ask("render", render)


def test_a_late_reply_is_refused_until_a_reset(session: EnvSession, lane: FakeLane) -> None:
    lane.fails = errors.WorkerTimeoutError("late")
    with pytest.raises(errors.WorkerTimeoutError, match=r"render has not .* waits longer"):
        session.requests.ask("render", render)
    assert (session.lifecycle.state, session.counters.timeouts) == (State.LATE, 1)
    with pytest.raises(errors.WorkerTimeoutError, match="the reply to the last request is late"):
        session.requests.submit_step(ACTIONS)
    session.recover()
    assert session.lifecycle.state is State.READY
    lane.fails = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        session.requests.ask("render", render)
    with pytest.raises(errors.WorkerTimeoutError, match="the last render was interrupted"):
        session.requests.submit_step(ACTIONS)


def test_a_request_after_close_is_refused(session: EnvSession) -> None:
    session.requests.closed, session.requests.face = True, "Env"
    with pytest.raises(ClosedEnvironmentError, match="`Env`, after a call to `close"):
        session.requests.ask("render", render)


def test_a_close_by_a_signal_in_a_wait_says_closed(session: EnvSession, lane: FakeLane) -> None:
    """Whatever the wait ended in; and nothing of the environment is left."""

    def closing(deadline: object) -> Any:
        session.requests.closed = True
        session.close()
        raise OSError("the socket is gone")

    lane.replies = closing
    with pytest.raises(ClosedEnvironmentError):
        session.requests.ask("render", render)
    assert lane.closed


# --- warnings ----------------------------------------------------------------------------------


def test_what_only_sends_is_not_stopped_by_a_filter(session: EnvSession, lane: FakeLane) -> None:
    """The reply would be owed, and the next request refused. No filter hides a Ctrl-C."""
    unshown = session.repository.warnings.unshown
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        unshown.append(("Warning", "sent"))
        session.requests.submit("render", render)
        with pytest.raises(errors.RemoteEnvWarning, match="sent"):
            session.requests.collect(1.0, m.Value)
        assert lane.owed is None
        session.requests.ask("render", render)
        unshown.append(("Warning", "one"))
        lane.fails = KeyboardInterrupt()
        with pytest.raises(KeyboardInterrupt):
            session.requests.ask("render", render)
