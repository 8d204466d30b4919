"""One request to all workers: every one is waited for, and one failure is raised for all."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError

from envhub_sandbox.errors import LocalProtocolError, RemoteEnvError, WorkerDiedError
from envhub_sandbox.session.parts.fleet_requests import FleetRequests
from envhub_sandbox.session.parts.fleet_session import FleetSession
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import State
from tests.support.in_process.fake_lane import FakeLane, fleet_over

ACTIONS = np.array([0, 1])


@pytest.fixture
def lanes() -> list[FakeLane]:
    """To two workers with a sub-environment each."""
    lanes = [FakeLane(1), FakeLane(1)]
    for row, lane in enumerate(lanes):
        lane.answer = m.Value((row,))
    return lanes


@pytest.fixture
def session(lanes: list[FakeLane]) -> FleetSession:
    return fleet_over(lanes)


@pytest.fixture
def requests(session: FleetSession) -> FleetRequests:
    return session.requests


def call(number: int, bounds: tuple[int, int]) -> m.Call:
    return m.Call(number, "act", (), {})


def raised(text: str) -> m.RaisedException:
    return m.RaisedException("ValueError", "ValueError", text, "", "call")


def states(session: FleetSession) -> list[State]:
    return [part.lifecycle.state for part in session.parts]


def test_each_worker_is_sent_its_rows(
    requests: FleetRequests, lanes: list[FakeLane], session: FleetSession
) -> None:
    requests.submit_step(ACTIONS)
    observation, rewards, *_ = requests.collect_step(None)
    assert (observation.shape, rewards.shape) == ((2, 3), (2,))
    sent = [message for lane in lanes for message in lane.sent]
    assert [one.actions.tolist() for one in sent if isinstance(one, m.Step)] == [[0], [1]]
    assert requests.one_each("act", requests.ask("act", call)) == (0, 1)
    requests.waiting = "step"
    with pytest.raises(AlreadyPendingCallError):
        requests.ask("act", call)
    requests.closed = True
    assert all(part.requests.closed for part in session.parts)
    with pytest.raises(ClosedEnvironmentError):
        requests.ask("act", call)


def test_every_worker_is_waited_for_where_one_fails(
    requests: FleetRequests, lanes: list[FakeLane], session: FleetSession
) -> None:
    """A death is raised rather than an exception of the repository; no lane owes an answer."""
    for row, lane in enumerate(lanes):
        lane.answer = raised(f"row {row}")
    for _ in range(2):
        with pytest.raises(RemoteEnvError, match="row 0"):  # of equal ones the first, by the rows
            requests.ask("act", call)
    assert states(session) == [State.READY, State.READY]
    lanes[1].fails = WorkerDiedError("gone")
    with pytest.raises(WorkerDiedError, match=r"sub-environment 1 of 2, on here"):
        requests.ask("act", call)
    assert lanes[0].owed is None
    assert states(session) == [State.READY, State.DEAD]
    with pytest.raises(WorkerDiedError, match="sub-environment 1 of 2"):
        requests.submit_step(ACTIONS)
    assert lanes[0].owed is None, "nothing is sent unless all workers are ready"


def test_a_worker_that_was_sent_nothing_falls_behind(
    requests: FleetRequests,
    lanes: list[FakeLane],
    session: FleetSession,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The others were: it is raised when they are waited for, and only a reset may follow."""

    def refuses(actions: Any, *, ahead: bool = False) -> None:
        raise LocalProtocolError("too large to send")

    monkeypatch.setattr(lanes[1], "send_step", refuses)
    requests.submit_step(ACTIONS)
    with pytest.raises(LocalProtocolError, match="too large"):
        requests.collect_step(None)
    assert states(session) == [State.READY, State.LATE]
    assert lanes[0].owed is None
    monkeypatch.setattr(lanes[0], "send_step", refuses)
    session.parts[1].lifecycle.state = State.READY
    with pytest.raises(LocalProtocolError):
        requests.submit_step(ACTIONS)
    assert states(session) == [State.READY, State.READY], "nothing was sent to anybody"


def test_one_sub_environment_is_asked_of_its_worker_alone(
    requests: FleetRequests, lanes: list[FakeLane]
) -> None:
    asked: list[int | None] = []

    def message(number: int, place: int | None) -> m.Message:
        asked.append(place)
        return m.Call(number, "act", (), {})

    requests.ask_one("act", 1, message)
    assert asked == [0]
    assert [len(lane.sent) for lane in lanes] == [0, 1]
    lanes[1].fails = WorkerDiedError("gone")
    with pytest.raises(WorkerDiedError, match="sub-environment 1 of 2"):
        requests.ask_one("act", 1, message)


def test_the_locks_of_all_are_held_at_once(requests: FleetRequests, session: FleetSession) -> None:
    """By one thread; another gets none of them until they are released."""
    got: list[bool] = []

    def other() -> None:
        for part in session.parts:
            got.append(part.use.lock.acquire(blocking=False))
            if got[-1]:
                part.use.lock.release()

    def tried() -> list[bool]:
        got.clear()
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        return list(got)

    with requests.use.lock:
        assert requests.use.is_mine
        with requests.use.lock:
            assert tried() == [False, False]
        assert requests.use.is_mine
    assert not requests.use.is_mine
    assert tried() == [True, True]
