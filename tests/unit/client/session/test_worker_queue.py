"""What one worker owes: how much it may, what a failure leaves, and what an interrupt shows."""

from typing import Any

import numpy as np
import pytest
from gymnasium.error import AlreadyPendingCallError

from envhub_sandbox.errors import LocalProtocolError, RemoteProtocolError
from envhub_sandbox.extras.several_workers.worker_queue import WorkerQueue
from envhub_sandbox.session.env_session import EnvSession
from envhub_sandbox.transport.results import StepResult
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import State
from envhub_worker.protocol.limits import MAX_IN_FLIGHT
from tests.support.in_process.fake_lane import FakeLane, fleet_over

ACTIONS = np.zeros(1, np.int64)


@pytest.fixture
def lane() -> FakeLane:
    return FakeLane(1)


@pytest.fixture
def part(lane: FakeLane) -> EnvSession:
    return fleet_over([FakeLane(1), lane]).parts[1]


@pytest.fixture
def queue(part: EnvSession) -> WorkerQueue:
    return WorkerQueue(part, part.rows, sliced=True)


def taken(queue: WorkerQueue) -> StepResult:
    kept: list[StepResult] = []
    queue.take(kept.append)
    [result] = kept
    return result


def reset(number: int, bounds: tuple[int, int]) -> m.Reset:
    return m.Reset(number, None, None, None)


def step(queue: WorkerQueue) -> None:
    queue.prepare()
    queue.step(ACTIONS)


def test_so_many_may_be_owed_and_no_more(queue: WorkerQueue, lane: FakeLane) -> None:
    assert (queue.rows, queue.count, queue.busy, queue.lane) == ((1, 2), 1, False, None)
    for _ in range(MAX_IN_FLIGHT):
        step(queue)
    assert queue.lane is lane
    with pytest.raises(AlreadyPendingCallError, match=f"{MAX_IN_FLIGHT} times.*environment 1 "):
        queue.prepare()
    taken(queue)
    step(queue)
    for _ in range(MAX_IN_FLIGHT):
        taken(queue)
    assert not queue.busy
    assert len(lane.sent) == MAX_IN_FLIGHT + 1


def test_a_reset_waits_for_nothing_and_nobody(queue: WorkerQueue, part: EnvSession) -> None:
    """It is refused while an answer is owed; its own has rewards of 0 and no flags."""
    step(queue)
    with pytest.raises(AlreadyPendingCallError, match="send_reset"):
        queue.prepare_reset()
    taken(queue)
    queue.prepare_reset()
    queue.reset(reset)
    assert 0 < (queue.left_s or 0) <= part.repository.timeouts.reset_s
    observation, rewards, terminations, truncations, infos = taken(queue)
    assert (observation.shape, rewards.tolist(), infos) == ((1, 3), [0.0], {})
    assert not terminations.any()
    assert terminations is not truncations, "the caller may write into one of them"


def test_what_could_not_be_sent_is_raised_where_it_is_received(
    queue: WorkerQueue, lane: FakeLane, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once, with the sub-environment's number; the worker owes nothing then."""
    step(queue)
    step(queue)

    def refuses(actions: Any, *, ahead: bool = False) -> None:
        raise LocalProtocolError("too large to send")

    with monkeypatch.context() as patch:
        patch.setattr(lane, "send_step", refuses)
        taken(queue)  # the second, which has waited here, goes out now
    assert queue.busy, "there is a failure to be raised"
    assert queue.lane is None, "and no worker to wait for"
    with pytest.raises(LocalProtocolError, match="too large") as caught:
        taken(queue)
    assert caught.value.env_ids == (1,)
    assert not queue.busy
    step(queue)
    assert taken(queue)[1].tolist() == [0.0]


def test_an_interrupt_in_an_answer_shows(queue: WorkerQueue, lane: FakeLane) -> None:
    """Until it is forgotten: ``drop`` takes no further answer out of what is half taken."""
    step(queue)
    lane.fails = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        taken(queue)
    assert (queue.taking, queue.interrupted, queue.busy) == (True, True, True)
    queue.drop()
    assert (queue.taking, queue.interrupted, queue.busy) == (False, False, False)
    assert lane.owed is not None, "a reset catches up with it"


def test_rewards_of_a_worker_among_others_are_one_number_each() -> None:
    """Else they cannot be joined with others'; alone, a worker may give any shape."""

    class Wide(FakeLane):
        def result(self) -> StepResult:
            observation, _, *rest = super().result()
            return (observation, np.zeros((1, 2)), *rest)

    session = fleet_over([FakeLane(1), Wide(1)]).parts[1]
    alone = WorkerQueue(session, session.rows, sliced=False)
    step(alone)
    assert taken(alone)[1].shape == (1, 2)
    among = WorkerQueue(session, session.rows, sliced=True)
    step(among)
    with pytest.raises(RemoteProtocolError, match="one number each"):
        taken(among)
    assert session.lifecycle.state is State.DEAD
