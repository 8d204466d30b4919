"""One request to several workers: who was sent nothing, and who alone is asked."""

from typing import Any

import numpy as np
import pytest

from envhub_sandbox import errors
from envhub_sandbox.extras.several_workers.fleet_session import FleetRequests, FleetSession
from envhub_sandbox.extras.several_workers.in_flight import InFlight
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import State
from tests.support.in_process.fake_lane import FakeLane, fleet_over

ACTIONS = np.array([0, 1])


@pytest.fixture
def lanes() -> list[FakeLane]:
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


def states(session: FleetSession) -> list[State]:
    return [part.lifecycle.state for part in session.parts]


def test_a_worker_that_was_sent_nothing_falls_behind(
    requests: FleetRequests,
    lanes: list[FakeLane],
    session: FleetSession,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The others were: it is raised when they are waited for, and only a reset may follow."""

    def refuses(actions: Any, *, ahead: bool = False) -> None:
        raise errors.LocalProtocolError("too large to send")

    monkeypatch.setattr(lanes[1], "send_step", refuses)
    requests.submit_step(ACTIONS)
    with pytest.raises(errors.LocalProtocolError, match="too large"):
        requests.collect_step(None)
    assert states(session) == [State.READY, State.LATE]
    assert lanes[0].owed is None
    monkeypatch.setattr(lanes[0], "send_step", refuses)
    session.parts[1].lifecycle.state = State.READY
    with pytest.raises(errors.LocalProtocolError):
        requests.submit_step(ACTIONS)
    assert states(session) == [State.READY, State.READY], "nothing was sent to anybody"


def test_one_is_asked_of_its_worker_alone(requests: FleetRequests, lanes: list[FakeLane]) -> None:
    asked: list[int | None] = []

    def message(number: int, place: int | None) -> m.Message:
        asked.append(place)
        return m.Call(number, "act", (), {})

    requests.ask_one("act", 1, message)
    assert asked == [0]
    assert [len(lane.sent) for lane in lanes] == [0, 1]
    lanes[1].fails = errors.WorkerDiedError("gone")
    with pytest.raises(errors.WorkerDiedError, match="sub-environment 1 of 2"):
        requests.ask_one("act", 1, message)


# --- What was sent to workers and not received


@pytest.fixture
def flight(session: FleetSession) -> InFlight:
    return InFlight(session.requests, session.parts)


def send(flight: InFlight, *ids: int) -> None:
    rows = flight.rows(list(ids))
    flight.send(rows, np.zeros(len(ids), np.int64))


def received(flight: InFlight, min_ready: int = 1) -> list[int]:
    found: list[int] = flight.recv(min_ready, 0).env_ids.tolist()
    return found


def test_torn_connection_is_refused_until_a_reset(flight: InFlight, lanes: list[FakeLane]) -> None:
    """What the next message would be taken for is not known; nothing more is sent or taken."""
    send(flight, 0, 1)
    lanes[1].jail.client.torn = True
    with pytest.raises(errors.WorkerError, match="interrupted"):
        flight.recv(1, 0)
    with pytest.raises(errors.WorkerError, match="interrupted"):
        send(flight, 0)
    flight.drop()
    assert lanes[0].owed is None
    assert lanes[1].owed is not None, "a reset gives it up"


def test_infos_that_break_a_rule_end_their_worker_alone(
    flight: InFlight, lanes: list[FakeLane], session: FleetSession
) -> None:
    lanes[0].infos = {"x": [1]}
    send(flight, 0, 1)
    with pytest.raises(errors.RemoteProtocolError):
        flight.recv(2, 0)
    assert [part.lifecycle.state for part in session.parts] == [State.DEAD, State.PENDING]
    assert received(flight, 2) == [1]
    lanes[1].infos = {0: {"x": 1}, 1: {"x": "text"}}  # an episode's, and the next one's
    send(flight, 1)
    with pytest.raises(errors.RemoteEnvError, match="info 'x' of sub-environment 0"):
        flight.recv(1, 0)
    assert session.parts[1].lifecycle.state is State.READY
