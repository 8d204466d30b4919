"""One request to all workers: every one is waited for, and one failure is raised for all."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError

from envhub_sandbox.errors import (
    ActionError,
    LocalProtocolError,
    RemoteEnvError,
    RemoteProtocolError,
    WorkerDiedError,
    WorkerError,
    WorkerTimeoutError,
)
from envhub_sandbox.session.parts.fleet_session import FleetRequests, FleetSession
from envhub_sandbox.session.parts.in_flight import SENT, InFlight
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


# --- What was sent to workers and not received: which results come, and what is noted meanwhile


@pytest.fixture
def flight(session: FleetSession) -> InFlight:
    return InFlight(session.requests, session.parts)


def send(flight: InFlight, *ids: int) -> None:
    rows = flight.rows(list(ids))
    flight.send(rows, np.zeros(len(ids), np.int64))


def received(flight: InFlight, min_ready: int = 1) -> list[int]:
    found: list[int] = flight.recv(min_ready, 0).env_ids.tolist()
    return found


def test_who_answers_first_comes_first(flight: InFlight, lanes: list[FakeLane]) -> None:
    lanes[0].silent = True
    send(flight, 0, 1)
    assert received(flight) == [1]
    lanes[0].silent = False
    send(flight, 1)
    assert received(flight) == [0]
    send(flight, 0)
    assert [received(flight), received(flight)] == [[1], [0]]


def test_the_environment_is_pending_meanwhile(flight: InFlight, session: FleetSession) -> None:
    with pytest.raises(NoAsyncCallError):
        flight.recv(1, 0)
    send(flight, 0, 1)
    assert session.requests.waiting == SENT
    with pytest.raises(AlreadyPendingCallError):
        session.requests.refuse_if_busy("step_async")
    received(flight)
    assert session.requests.waiting == SENT
    received(flight)
    assert session.requests.waiting is None
    assert session.lifecycle.state is State.READY
    session.parts[1].lifecycle.state = State.DEAD
    with pytest.raises(WorkerDiedError) as caught:
        send(flight, 0, 1)
    assert caught.value.env_ids == (1,)
    assert session.requests.waiting is None, "nothing was sent, to nobody"
    assert session.parts[0].lifecycle.state is State.READY


def test_what_is_dropped_is_waited_for(
    flight: InFlight, lanes: list[FakeLane], session: FleetSession
) -> None:
    """And what waits here is not sent. The history says where workers were sent other steps."""
    flight.send(flight.rows(None), np.zeros(2, np.int64))
    flight.recv(2, 0)
    history = session.parts[0].history
    assert history.recording().dropped == 0
    send(flight, 0, 1)
    send(flight, 0)
    flight.drop()
    assert [len(lane.sent) for lane in lanes] == [2, 2]
    assert [lane.owed for lane in lanes] == [None, None]
    with pytest.raises(NoAsyncCallError):
        flight.recv(1, 0)
    assert history.recording().dropped == 1


def test_ids_are_read_as_they_are_meant(flight: InFlight) -> None:
    """In any order, which is kept; each once, and each one that there is."""
    assert flight.rows(None) == ([0, 1], [0, 1], None)
    assert flight.rows(np.array([1, 0])) == ([1, 0], [0, 1], [1, 0])
    for wrong in ([2], [-1], [0, 0], [], [[0]], [[0], [0, 1]], [0.5], 1, ["0"]):
        with pytest.raises(ActionError, match="env_ids"):
            flight.rows(wrong)


def test_steps_wait_here_for_one_that_takes_one_at_a_time(
    flight: InFlight, lanes: list[FakeLane]
) -> None:
    """The next goes out when the last has been answered; their arrays may be written meanwhile."""
    lanes[0].silent = True
    actions = np.array([1])
    for action in (1, 0, 1):
        actions[0] = action
        flight.send(flight.rows([0]), actions)
    assert len(lanes[0].sent) == 1
    lanes[0].silent = False
    for _ in range(3):
        received(flight)
    steps = [one for one in lanes[0].sent if isinstance(one, m.Step)]
    assert [one.actions.tolist() for one in steps] == [[1], [0], [1]]


class Switching(FakeLane):
    """A lane that takes more once a step was sent while that was wanted: see ``ServedLane``."""

    def __init__(self, count: int) -> None:
        super().__init__(count)
        self.wanted, self.ahead = False, list[bool]()

    def expect_more(self) -> None:
        """From the next step on that is sent alone."""
        self.wanted = True

    def send_step(self, actions: Any, *, ahead: bool = False) -> None:
        assert self.takes_more or not ahead
        if not ahead:
            self.takes_more, self.wanted = self.wanted, False
        self.ahead.append(ahead)
        self.owed = None
        super().send_step(actions, ahead=ahead)


def test_steps_that_wait_go_out_together_once_they_can() -> None:
    """However many there are: one by one, each would wait for the way there and back again."""
    lanes = [Switching(1), FakeLane(1)]
    session = fleet_over(lanes)
    flight = InFlight(session.requests, session.parts)
    lanes[0].silent = True
    for action in range(4):
        flight.send(flight.rows([0]), np.array([action]))
    lanes[0].silent = False
    assert lanes[0].ahead == [False]
    received(flight)
    assert lanes[0].ahead == [False, False, True, True]
    for _ in range(4):
        send(flight, 0)
        received(flight)
    assert lanes[0].ahead == [False, False, *[True] * 6], "and it stays so"
    for _ in range(3):
        received(flight)
    with pytest.raises(NoAsyncCallError):
        received(flight)
    steps = [one for one in lanes[0].sent if isinstance(one, m.Step)]
    assert [one.actions.tolist() for one in steps[:4]] == [[0], [1], [2], [3]]


def test_a_torn_connection_is_refused_until_a_reset(
    flight: InFlight, lanes: list[FakeLane]
) -> None:
    """What the next message would be taken for is not known; nothing more is sent or taken."""
    send(flight, 0, 1)
    lanes[1].jail.client.torn = True
    with pytest.raises(WorkerError, match="interrupted"):
        flight.recv(1, 0)
    with pytest.raises(WorkerError, match="interrupted"):
        send(flight, 0)
    flight.drop()
    assert lanes[0].owed is None
    assert lanes[1].owed is not None, "a reset gives it up"


def test_an_error_names_its_worker_and_keeps_no_other(
    flight: InFlight, lanes: list[FakeLane]
) -> None:
    """Whatever it is; what was queued behind a death goes with it."""
    lanes[1].silent = True
    send(flight, 0, 1)
    send(flight, 0)
    lanes[0].fails = WorkerDiedError("gone")
    with pytest.raises(WorkerDiedError, match="sub-environment 0 of 2") as caught:
        flight.recv(2, None)
    assert caught.value.env_ids == (0,)
    lanes[1].silent = False
    assert received(flight, 2) == [1]
    with pytest.raises(NoAsyncCallError):
        flight.recv(1, 0)


def test_a_timeout_of_the_caller_takes_nothing(flight: InFlight, lanes: list[FakeLane]) -> None:
    lanes[1].silent = True
    send(flight, 0, 1)
    with pytest.raises(WorkerTimeoutError, match="nothing is lost"):
        flight.recv(2, 0.01)
    assert received(flight) == [0]
    lanes[1].silent = False
    assert received(flight) == [1]


def test_infos_that_break_a_rule_end_their_worker_alone(
    flight: InFlight, lanes: list[FakeLane], session: FleetSession
) -> None:
    lanes[0].infos = {"x": [1]}
    send(flight, 0, 1)
    with pytest.raises(RemoteProtocolError):
        flight.recv(2, 0)
    assert [part.lifecycle.state for part in session.parts] == [State.DEAD, State.PENDING]
    assert received(flight, 2) == [1]
    lanes[1].infos = {None: None}
    send(flight, 1)
    with pytest.raises(RemoteEnvError, match="do not go together"):  # as Gymnasium's
        flight.recv(1, 0)
    assert session.parts[1].lifecycle.state is State.READY
