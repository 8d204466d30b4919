"""``send`` and ``recv``: who is ready first comes first, and what is refused meanwhile."""

import contextlib
import os
import pickle
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError

from envhub_sandbox import errors
from tests.support import inside
from tests.support.objects.gates import DIE, LARGE, RAISE, Gates, ids, send


@pytest.fixture(params=["auto", "frames"])
def lane(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def gates(tmp_path: Path, lane: str) -> Iterator[Gates]:
    with ExitStack() as stack:
        yield Gates(tmp_path, stack, policy={"lane": lane}, min_ready=2)


def test_who_is_ready_first_comes_first(gates: Gates) -> None:
    """The rows are in the order of the ids; as many as were wanted, and no others. What is ready
    beside them stays for the next call."""
    env = gates.env(4)
    send(env, 1, 2, 3, 4)
    gates.open(3, 1)
    observations, rewards, terminations, truncations, infos, env_ids = env.recv()
    assert (env_ids.tolist(), observations.tolist()) == ([0, 2], [[1, 1], [1, 3]])
    assert rewards.tolist() == [1.0, 3.0]
    assert [terminations.tolist(), truncations.tolist()] == [[False] * 2] * 2
    assert infos["said"].tolist() == ["x", "x"]
    assert (rewards.dtype, env_ids.dtype) == (np.float64, np.int64)
    env.send([[5, 0], [6, 0]], [2, 0])  # in whatever order
    gates.open(6)
    assert ids(env.recv(min_ready=1)) == [0]
    gates.open(2, 4, 5)
    assert ids(env.recv(min_ready=3)) == [1, 2, 3]
    env.send(np.array([[0, LARGE], [0, 0], [0, LARGE], [0, 0]]))
    got = [env.recv(1) for _ in range(4)]
    assert sorted(ids(one)[0] for one in got) == [0, 1, 2, 3]
    assert {ids(one)[0]: len(one.infos["said"][0]) for one in got}[2] == 200_000
    send(env, 0, ids=[1])
    assert ids(env.recv(4)) == [1], "no more were sent anything"


def test_whoever_raises_does_not_take_the_others_along(gates: Gates) -> None:
    """It says who it is; its worker goes on, and the others' results come as ever. What was sent
    ahead of the error is taken by the sub-environment as it is after that."""
    env = gates.env(3)
    send(env, 1, 2, 3)
    gates.open(1)
    assert ids(env.recv(1)) == [0]
    send(env, 4, ids=[0], what=RAISE)
    send(env, 5, ids=[0])
    gates.open(4)
    with pytest.raises(errors.RemoteEnvError, match="no, at gate 4") as caught:
        env.recv(1)
    assert caught.value.env_ids == (0,)
    gates.open(2, 3, 5)
    received = env.recv(3)
    assert (ids(received), received.rewards.tolist()) == ([0, 1, 2], [5.0, 2.0, 3.0])
    assert received.observations[:, 0].tolist() == [3, 1, 1]


def test_actions_may_be_sent_ahead(gates: Gates) -> None:
    """They are taken one after the other, each gives its results, and no batch has one twice."""
    env = gates.env(2)
    actions = np.array([[1, 0]])
    for gate in (1, 0, 2, 0):
        actions[0, 0] = gate
        env.send(actions, [0])  # which may be written to at once
    send(env, 0, ids=[1])
    gates.open(1)
    got = [env.recv(1) for _ in range(3)]
    assert sorted(map(ids, got)) == [[0], [0], [1]]
    assert [one.rewards[0] for one in got if ids(one) == [0]] == [1.0, 0.0]
    gates.open(2)
    got = [env.recv(2), env.recv(2)]
    assert [(ids(one), one.rewards.tolist()) for one in got] == [([0], [2.0]), ([0], [0.0])]
    assert got[1].observations.tolist() == [[4, 1]]


def test_a_reset_is_sent_and_received(gates: Gates) -> None:
    """With seeds by the sub-environments' numbers, as in ``reset``; others go on meanwhile. One of
    all drops what is in flight: steps that were sent are made, and those that wait here are not."""
    env = gates.env(3)
    send(env, 1, ids=[1])
    env.send_reset([2, 0], seed=[70, 80], options={"gate": 2})
    gates.open(2)
    received = env.recv(2)
    assert (ids(received), received.observations[:, 1].tolist()) == ([0, 2], [80, 70])
    assert received.rewards.tolist() == [0.0, 0.0]
    assert not received.terminations.any()
    assert received.infos["options"].tolist() == ["{'gate': 2}"] * 2
    env.send_reset([2, 0], seed=5)
    gates.open(1)
    received = env.recv(3)
    assert received.observations[:, 1].tolist() == [5, 2, 7]
    assert received.rewards.tolist() == [0.0, 1.0, 0.0]
    env.send_reset()
    assert env.recv(3).observations[:, 1].tolist() == [5, 2, 7]
    send(env, 3, 0, 0)
    send(env, 0, 0, 0)
    gates.open(3)
    observations, _ = env.reset(seed=40)
    made = observations[:, 0].tolist()
    assert observations[:, 1].tolist() == [40, 41, 42]
    with pytest.raises(NoAsyncCallError):
        env.recv()
    results = env.step(np.zeros((3, 2), np.int64))
    assert results[0][:, 0].tolist() == [one + 1 for one in made]


def test_other_requests_are_refused_meanwhile(gates: Gates) -> None:
    """Until all has been received; and ``recv`` where nothing was sent."""
    env = gates.env(2)
    with pytest.raises(NoAsyncCallError, match="without any prior call to `send`"):
        env.recv()
    send(env, 1, ids=[1])
    mask = np.array([True, False])
    calls = {
        "step_async": lambda: env.step(np.zeros((2, 2), np.int64)),
        "reset_async": lambda: env.reset(options={"reset_mask": mask}),
        "call_async": lambda: env.call("steps"),
        "render": env.render,
        "set_attr": lambda: env.set_attr("steps", 1),
        r"envs\[0\].steps": lambda: env.envs[0].get_wrapper_attr("steps"),
    }
    for name, call in calls.items():
        with pytest.raises(AlreadyPendingCallError, match=f"`{name}`.* call to `send`"):
            call()
    with pytest.raises(AlreadyPendingCallError, match="sub-environment 1"):
        env.send_reset([1])
    gates.open(1)
    env.recv(1)
    assert env.call("steps") == (0, 1)
    env.step_async(np.zeros((2, 2), np.int64))
    with pytest.raises(AlreadyPendingCallError, match=r"`send` while .* `step`"):
        send(env, 0, 0)
    with pytest.raises(NoAsyncCallError):
        env.recv()
    env.step_wait()
    send(env, 9, 9)
    env.close()  # without a warning, since there is no end to a loop of these
    for refused in (env.recv, lambda: send(env, 0, 0), env.send_reset):
        with pytest.raises(ClosedEnvironmentError):
            refused()


def test_what_cannot_be_meant_is_refused(gates: Gates) -> None:
    env = gates.env(3, num_workers=2)
    wrong = {
        "sub-environments 0 to 1 are stepped together, .* lacks 1": [0],
        "sub-environments are 0 to 2": [0, 1, 3],
        "twice": [2, 2],
        r"it takes a list such as \[0, 3\]": [[0, 1]],
    }
    for text, env_ids in wrong.items():
        with pytest.raises(errors.ActionError, match=text):
            send(env, *[0] * len(env_ids), ids=env_ids)
    for unreadable in ([-1], [], [[0], [0, 1]], [0.5], 1, ["0"]):
        with pytest.raises(errors.ActionError, match="env_ids"):
            env.send(np.zeros((1, 2), np.int64), unreadable)
    for actions in (np.zeros((2, 2), np.int64), np.zeros((1, 3), np.int64), [[0.5, 0]]):
        with pytest.raises(errors.ActionError):
            env.send(actions, [2])
    with pytest.raises(ValueError, match="`min_ready` is 0"):
        env.recv(0)
    with pytest.raises(ValueError, match="2 entries for 1 sub-environments"):
        env.send_reset([2], seed=[1, 2])
    with pytest.raises(ValueError, match="name sub-environments by `env_ids`"):
        env.send_reset(options={"reset_mask": np.ones(3, np.bool_)})
    with pytest.raises(NoAsyncCallError):
        env.recv()
    send(env, 0, 0, ids=[1, 0])
    assert ids(env.recv()) == [0, 1]


def test_one_worker_is_ready_as_a_whole(gates: Gates) -> None:
    """A wait for fewer is refused, and takes nothing away."""
    env = gates.env(4, min_ready=None, num_workers=1)
    send(env, 0, 0, 0, 1)
    for wanted in (1, 3):
        with pytest.raises(ValueError, match=r"one worker steps all 4 .* and no `num_workers"):
            env.recv(wanted)
    gates.open(1)
    assert env.recv().rewards.tolist() == [0.0, 0.0, 0.0, 1.0]
    env = gates.env(4, num_workers=2, min_ready=None, policy={"restart": "transparent"})
    send(env, 0, 0, 0, 0)
    with pytest.raises(ValueError, match=r"transparent.* and no `num_workers=1`"):
        env.recv(1)
    assert ids(env.recv()) == [0, 1, 2, 3]


@pytest.fixture
def shards(tmp_path: Path, lane: str) -> Iterator[Gates]:
    with ExitStack() as stack:
        yield Gates(tmp_path, stack, policy={"lane": lane})


def test_workers_of_one_jail_are_ready_one_by_one(shards: Gates) -> None:
    """Without ``min_ready`` for ``make_env``, after a reset and steps of all, and before them."""
    env = shards.env(6, num_workers=3)
    with pytest.raises(errors.ActionError, match="env_ids lacks 1"):
        send(env, 0, ids=[0])
    send(env, 1, 0, 0, 0, 2, 2)
    assert ids(env.recv(1)) == [2, 3]
    send(env, 0, 3, ids=[3, 2], what=LARGE)  # in whatever order, and more than one at a time
    send(env, 0, 0, ids=[2, 3])
    shards.open(2, 3)
    got = [env.recv(1) for _ in range(3)]
    assert [ids(one) for one in got if ids(one) == [2, 3]] == [[2, 3]] * 2
    assert [one.observations[:, 0].tolist() for one in got if ids(one) == [2, 3]] == [
        [2, 2],
        [3, 3],
    ]
    with pytest.raises(errors.WorkerTimeoutError):
        env.recv(1, timeout=0.1)
    shards.open(1)
    assert ids(env.recv()) == [0, 1]
    assert env.step(np.zeros((6, 2), np.int64))[0][:, 0].tolist() == [2, 2, 4, 4, 2, 2]
    env.send_reset([4, 5], seed=7)
    assert env.recv().observations[:, 1].tolist() == [11, 12]
    with pytest.raises(NoAsyncCallError):
        env.recv(1)


def test_what_one_worker_of_a_jail_raises_is_its_own(shards: Gates) -> None:
    """It takes its next action, and the others' results come."""
    env = shards.env(2, num_workers=2)
    env.send(np.array([[0, RAISE], [1, 0]]))
    send(env, 0, ids=[0])
    with pytest.raises(errors.RemoteEnvError) as caught:
        env.recv(1)
    assert (caught.value.env_ids, ids(env.recv(1))) == ((0,), [0])
    shards.open(1)
    assert ids(env.recv(1)) == [1]


def test_a_death_takes_the_workers_of_a_jail_along(shards: Gates) -> None:
    """The error names all whose results are lost; what came before it is there."""
    env = shards.env(3, num_workers=3, policy={"restart": "on_reset"})
    env.send(np.array([[0, 0], [1, DIE], [2, 0]]))
    with contextlib.suppress(errors.WorkerTimeoutError):  # until the first has answered
        env.recv(2, timeout=1)
    shards.open(1)
    with pytest.raises(errors.WorkerDiedError) as caught:
        env.recv(2)
    assert (caught.value.env_ids, ids(env.recv())) == ((1, 2), [0])
    assert env.reset(seed=1)[0].tolist() == [[0, 1], [0, 2], [0, 3]]


def test_who_is_late_in_a_jail_holds_nobody_up_before(shards: Gates) -> None:
    env = shards.env(3, num_workers=3)
    env.reset()
    with inside.hurried(env, step_s=1.0):
        send(env, 0, 1, 1)
        assert ids(env.recv(1)) == [0]
        with pytest.raises(errors.WorkerTimeoutError) as late:
            env.recv(1)
    assert late.value.env_ids == (1, 2)
    shards.open(1)
    assert env.reset(seed=1)[0][:, 1].tolist() == [1, 2, 3]


def test_who_closes_ends_the_wait_for_workers_of_one_jail(shards: Gates) -> None:
    env = shards.env(2, num_workers=2)
    send(env, 1, 1)
    closing = threading.Timer(0.3, env.close)
    closing.start()
    with pytest.raises(ClosedEnvironmentError):
        env.recv(1)
    closing.join()


def test_a_fork_neither_sends_nor_receives(gates: Gates) -> None:
    """What is in flight is its parent's; a copy has workers of its own."""
    env = gates.env(2)
    send(env, 1, 2)
    child = os.fork()
    if child == 0:
        refused = 0
        for call in (lambda: env.recv(1), lambda: send(env, 0, 0), env.send_reset):
            try:
                call()
            except errors.WorkerError:
                refused += 1
            except BaseException:
                os._exit(9)
        os._exit(refused)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 3
    with contextlib.closing(pickle.loads(pickle.dumps(env))) as again:
        again.reset(seed=1)
        send(again, 0, 0)
        assert ids(again.recv()) == [0, 1]
    gates.open(1, 2)
    assert ids(env.recv(2)) == [0, 1]
