"""Real lanes say when their step has been answered, and what to poll until then."""

import os
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox.errors import WorkerDiedError
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.lane import answered_first
from tests.support import inside
from tests.support.objects.gates import Gates
from tests.support.processes import eventually

pytestmark = pytest.mark.parametrize("lane", ["auto", "frames"])


@pytest.fixture
def gates(tmp_path: Path, lane: str) -> Iterator[Gates]:
    with ExitStack() as stack:
        yield Gates(tmp_path, stack, policy={"lane": lane})


def send(env: Any, *gates: int, large: int = 0) -> None:
    env.step_async(np.array([[gate, large] for gate in gates]))


def answered(*envs: Any, timeout_s: float | None = None) -> list[int]:
    lanes = [inside.session(env).lease.lane for env in envs]
    return answered_first([lane for lane in lanes if lane is not None], Deadline(timeout_s))


def test_who_answers_first_is_found_first(gates: Gates) -> None:
    """Whatever was sent first; and each gives the results of its own step."""
    one, other = gates.env(), gates.env()
    send(one, 1)
    send(other, 2)
    assert answered(one, other, timeout_s=0) == []
    gates.open(2)
    assert (answered(one, other), other.step_wait()[1].tolist()) == ([1], [2.0])
    send(other, 3)
    gates.open(1)
    assert (answered(one, other), one.step_wait()[1].tolist()) == ([0], [1.0])
    gates.open(3)
    assert (answered(other), other.step_wait()[1].tolist()) == ([0], [3.0])
    several = gates.env(2, use_async_envs=True, num_workers=2)
    send(several, 4, 5)
    gates.open(5)
    assert answered(several, timeout_s=0.2) == [], "it is one step, over two processes"
    gates.open(4)
    assert (answered(several), several.step_wait()[1].tolist()) == ([0], [4.0, 5.0])


def test_large_infos_belong_to_the_answer(gates: Gates) -> None:
    """Over shared memory they are fetched, which is begun here; what follows is as ever."""
    env = gates.env()
    for _ in range(3):
        send(env, 0, large=1)
        assert (answered(env), answered(env)) == ([0], [0])
        assert env.step_wait()[4]["said"].tolist() == ["x" * 200_000]
        assert env.step(np.array([[0, 1]]))[4]["said"].tolist() == ["x" * 200_000]
        assert env.step(np.array([[0, 0]]))[4]["said"].tolist() == ["x"]
    assert env.sandbox.stats()["stale_replies"] == 0
    send(env, 0, large=1)
    assert answered(env) == [0]
    inside.session(env).requests.waiting = None  # as after a Ctrl-C: they are dropped by a reset
    env.reset()
    assert env.step(np.array([[0, 0]]))[4]["said"].tolist() == ["x"]
    assert env.call("action_space")[0].nvec.tolist() == [1000, 4]


def test_a_reset_is_answered_as_well(gates: Gates) -> None:
    for policy in ({}, {"restart": "transparent"}):
        env = gates.env(policy=policy)
        env.reset_async(seed=1)
        assert (answered(env), env.reset_wait()[0].tolist()) == ([0], [[0, 1]])
        env.call_async("action_space")
        assert (answered(env), env.call_wait()[0].nvec.tolist()) == ([0], [1000, 4])


@pytest.mark.parametrize("restart", ["never", "transparent"])
def test_a_death_ends_the_wait(gates: Gates, restart: str) -> None:
    """There is nothing to wait for; what follows is said, or done, where the results are taken."""
    env, other = gates.env(policy={"restart": restart}), gates.env()
    runner = inside.pids(env)[0]
    send(env, 1)
    send(other, 1)
    os.kill(runner, signal.SIGKILL)
    assert answered(other, env) == [1]
    if restart == "never":
        with pytest.raises(WorkerDiedError):
            env.step_wait()
    else:
        assert env.step_wait()[3].tolist() == [True]
    gates.open(1)
    assert answered(other) == [0]
    other.step_wait()


def test_what_was_listened_to_steps_on_as_before(gates: Gates) -> None:
    """A look that found nothing, or an answer that nobody took, leaves nothing behind."""
    env = gates.env()
    send(env, 1)
    assert answered(env, timeout_s=0.05) == []
    gates.open(1)
    assert env.step_wait()[1].tolist() == [1.0]
    for _ in range(50):
        assert env.step(np.array([[0, 0]]))[1].tolist() == [0.0]
    send(env, 0)
    assert eventually(lambda: answered(env, timeout_s=0) == [0])
    assert env.step_wait()[1].tolist() == [0.0]
