"""Deaths, time-outs, Ctrl-C and ``close`` while workers are at what they were sent."""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError, NoAsyncCallError

from envhub_sandbox.errors import EnvHubError, WorkerDiedError, WorkerError, WorkerTimeoutError
from envhub_sandbox.extras.remote import served_lane
from envhub_sandbox.extras.several_workers import in_flight, worker_queue
from envhub_sandbox.session import requests
from envhub_sandbox.transport import connection
from envhub_sandbox.transport import lane as relay_lane
from envhub_sandbox.transport.shared_memory import slab_lane
from envhub_worker.protocol.lifecycle import State
from tests.support import inside
from tests.support.in_process.interrupts import before_line
from tests.support.objects.gates import DIE, Gates, ids, send
from tests.support.processes import eventually

lanes = pytest.mark.parametrize("lane", ["auto", "frames"])


@pytest.fixture
def gates(tmp_path: Path, lane: str) -> Iterator[Gates]:
    with ExitStack() as stack:
        yield Gates(tmp_path, stack, policy={"lane": lane}, min_ready=1)


Call = Callable[[], object]


def kill(env: Any, worker: int) -> None:
    for pid in inside.part_pids(inside.parts(env)[worker]):
        os.kill(pid, signal.SIGKILL)


def is_waited_for(env: Any, worker: int) -> bool:
    lock = inside.use_lock_of(inside.parts(env)[worker])
    if free := lock.acquire(blocking=False):
        lock.release()
    return not free


@lanes
def test_a_death_is_its_own(gates: Gates) -> None:
    """The others go on, without a reset; who has died takes nothing more."""
    env = gates.env(3)
    send(env, 1, 2, 3)
    kill(env, 1)
    with pytest.raises(WorkerDiedError, match=r"\(sub-environment 1 of 3, on process\)") as caught:
        env.recv(3)
    assert caught.value.env_ids == (1,)
    gates.open(1, 3)
    assert ids(env.recv(2)) == [0, 2]
    with pytest.raises(WorkerDiedError, match="cannot step: the worker process has died") as again:
        send(env, 0, 0, 0)
    assert again.value.env_ids == (1,)
    send(env, 0, 4, ids=[0, 2])
    assert ids(env.recv(1)) == [0]
    gates.open(4)
    assert ids(env.recv(3)) == [2]
    calls: list[Call] = [lambda: send(env, 0, ids=[1]), lambda: env.send_reset([1])]
    for call in calls:
        with pytest.raises(WorkerError, match="make the environment again") as refused:
            call()
        assert refused.value.env_ids == (1,)


@pytest.mark.parametrize(("lane", "of_itself"), [("auto", True), ("frames", False)])
def test_a_death_is_survived(gates: Gates, of_itself: bool) -> None:
    """With ``restart="transparent"`` its rows are cut off, and say so; the others go on. It has
    again what was set."""
    env = gates.env(3, policy={"restart": "transparent"})
    env.set_attr("steps", [10, 20, 30])
    send(env, 1, 2, 3)
    if of_itself:
        gates.open(2)
        env.recv(1)
        send(env, 0, ids=[1], what=DIE)
    else:
        kill(env, 1)
    received = env.recv(1)
    assert (ids(received), received.truncations.tolist()) == ([1], [True])
    assert received.rewards.tolist() == [0.0]
    assert received.infos["worker_restarted"].tolist() == [True]
    for steps in (20, 21):  # the first is the autoreset
        send(env, 0, ids=[1])
        assert env.recv(1).observations[0, 0] == steps
    gates.open(1, 3)
    received = env.recv(3)
    assert (ids(received), received.rewards.tolist()) == ([0, 2], [1.0, 3.0])
    assert "worker_restarted" not in received.infos


@lanes
def test_a_worker_is_brought_back_alone(gates: Gates) -> None:
    """With ``restart="on_reset"``, while the others are at their steps. One error for all that was
    sent ahead."""
    env = gates.env(2, policy={"restart": "on_reset"})
    send(env, 1, 2)
    for _ in range(2):
        send(env, 2, ids=[1])
    kill(env, 1)
    with pytest.raises(WorkerDiedError):
        env.recv(2)
    env.send_reset([1], seed=50)
    received = env.recv(1)
    assert (ids(received), received.observations.tolist()) == ([1], [[0, 51]])
    send(env, 0, ids=[1])
    assert ids(env.recv(1)) == [1]
    gates.open(1)
    assert env.recv(2).observations.tolist() == [[1, 1]]


@lanes
def test_a_step_may_take_too_long(gates: Gates) -> None:
    """Its worker is late, and is brought back by a reset; the others' results come.
    Who has answered in time is not late, however long a learner thinks before it takes that."""
    env = gates.env(2)
    with inside.hurried_part(env, 1, step_s=2.0):
        send(env, 0, 0)
        assert eventually(lambda: all(part.lease.lane.answered() for part in inside.parts(env)))
        threading.Event().wait(2.5)
        assert ids(env.recv(2)) == [0, 1]
        send(env, 0, 1)
        with pytest.raises(WorkerTimeoutError, match=r"step has not finished after 2\.0 s") as late:
            env.recv(2)
        assert (late.value.env_ids, ids(env.recv(2))) == ((1,), [0])
        send(env, 0, ids=[0])
        assert ids(env.recv(2)) == [0]
        with pytest.raises(WorkerTimeoutError, match="late") as again:
            send(env, 0, ids=[1])
        assert again.value.env_ids == (1,)
    gates.open(1)
    env.send_reset([1], seed=1)
    assert ids(env.recv(2)) == [1]
    send(env, 0, 0)
    assert ids(env.recv(2)) == [0, 1]


@lanes
def test_close_ends_a_wait(gates: Gates) -> None:
    env = gates.env(3)
    send(env, 1, 2, ids=[0, 2])
    with ThreadPoolExecutor(1) as threads:
        waiting = threads.submit(env.recv, 2)
        assert eventually(lambda: is_waited_for(env, 2))
        env.close()
        with pytest.raises(ClosedEnvironmentError, match="`SandboxVectorEnv`"):  # as after it
            waiting.result(60)
    for part in inside.parts(env):
        assert (part.lifecycle.state, part.lease.loaded) == (State.CLOSED, None)


@lanes
@pytest.mark.parametrize("count", [1, 2])
def test_a_signal_handler_closes_what_waits(
    gates: Gates, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    """Its own thread has the locks: it waits for nobody to release them."""
    monkeypatch.setattr(*inside.CLOSE_PATIENCE, 3600.0)
    env = gates.env(count)
    send(env, *range(1, count + 1))
    before = signal.signal(signal.SIGUSR1, lambda *_: env.close())
    try:
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGUSR1)).start()
        with pytest.raises(ClosedEnvironmentError):
            env.recv()
    finally:
        signal.signal(signal.SIGUSR1, before)


@lanes
def test_a_timeout_ends_the_wait_for_another_threads_recv(gates: Gates) -> None:
    """Whose own goes on."""
    env = gates.env(2)
    send(env, 1, 1)
    with ThreadPoolExecutor(1) as threads:
        own = threads.submit(env.recv, 2)
        assert eventually(lambda: is_waited_for(env, 0))
        with pytest.raises(WorkerTimeoutError, match=r"ready after 0\.01 s") as late:
            env.recv(2, timeout=0.01)
        assert (late.value.request, late.value.timeout_s, own.done()) == ("recv", 0.01, False)
        gates.open(1)
        assert ids(own.result(60)) == [0, 1]


@pytest.mark.parametrize("lane", ["auto"])
def test_a_timeout_ends_the_wait_of_the_first_recv_for_another_threads_reset(gates: Gates) -> None:
    env = gates.env(1)
    with ThreadPoolExecutor(1) as threads, inside.flight_of(env):
        late = threads.submit(env.recv, timeout=0.01)
        with pytest.raises(WorkerTimeoutError, match=r"ready after 0\.01 s"):
            late.result(60)


@lanes
def test_ctrl_c_ends_a_wait_and_loses_nothing(gates: Gates) -> None:
    """A wait takes nothing away: what was sent is received as ever."""
    env = gates.env(2)
    send(env, 1, 2)
    timer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):  # whichever of the two it comes into
        timer.start(), env.recv()
    gates.open(1, 2)
    assert ids(env.recv(2)) == [0, 1]


_OVER_A_SERVER = served_lane, slab_lane, relay_lane, connection
# in the client, over either lane; and further down, over the server
_PLACES = [
    ("auto", in_flight, 1),
    ("auto", worker_queue, 2),
    ("auto", requests, 1),
    ("frames", in_flight, 2),
    *(("frames", module, 2) for module in _OVER_A_SERVER),
]


def _called(one: Any) -> str:
    return str(getattr(one, "__name__", one)).rpartition(".")[2]


class Loop:
    """Some steps of two sub-environments, each known by its reward."""

    def __init__(self, env: Any, gates: Gates, first: int, ahead: int) -> None:
        self.env, self._gates, self._first, self._ahead = env, gates, first, ahead
        self.sent: list[list[int]] = [[], []]
        self.got: list[list[int]] = [[], []]

    def receive(self) -> None:
        received = self.env.recv(1)
        for index, reward in zip(ids(received), received.rewards, strict=True):
            self.got[index].append(int(reward))

    def run(self) -> None:
        for step in range(self._ahead):
            for index in (0, 1):
                number = self._first + step
                self.sent[index].append(number)
                self._gates.open(number)
                send(self.env, number, ids=[index])
        while sum(map(len, self.got)) < 2 * self._ahead:
            self.receive()


@pytest.mark.parametrize(("lane", "module", "ahead"), _PLACES, ids=_called)
def test_ctrl_c_anywhere_gives_no_step_anothers_results(
    gates: Gates, lane: str, module: Any, ahead: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is received afterwards are results of what was sent, in order; else it is refused until
    a reset, after which all is as ever."""
    monkeypatch.setattr(*inside.LATE_REPLY_GRACE, 0.5)  # where one is lost
    env = gates.env(2)
    # between two moments that are tried, of some hundreds
    lines = 41 if module in _OVER_A_SERVER else 7
    line, came = 0, True
    while came:
        number = 3 * line % 990 + 1
        loop = Loop(env, gates, number, ahead)
        came = before_line(module.__file__, line, loop.run)
        with contextlib.suppress(EnvHubError, NoAsyncCallError):
            while True:
                loop.receive()
        for index in (0, 1):
            expected = [one for one in loop.sent[index] if one in loop.got[index]]
            assert loop.got[index] == expected, line
        env.reset(seed=3)
        gates.open(number + 2)
        results = env.step(np.array([[number + 2, 0]] * 2))
        assert results[1].tolist() == [number + 2] * 2, line
        line += lines
    assert line > 2 * lines
