"""Attributes that are asked for after each step: watched, and never another value than there is."""

import contextlib
import random
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import WorkerDiedError, WorkerTimeoutError
from tests.support.compare import assert_same
from tests.support.processes import eventually
from tests.support.repositories import STILL

ENVS = 3
_TOLD = '''
import os
import signal
import threading
import time

ALL = []

class Told(Still):
    """Some attributes stay, some change with each step, some with each episode."""

    action_space = gym.spaces.Discrete(3)
    kind = "reacher"

    def __init__(self):
        self.task = "reach"
        self.steps = self.episodes = self.asked = 0
        self.ready = self.mortal = False
        ALL.append(self)

    def reset(self, *, seed=None, options=None):
        self.episodes += 1
        return 0, {}

    def step(self, action):
        self.steps += 1
        if self.mortal:
            self.die()
        if action == 2:
            self.task = self.late = f"task {self.steps}"
        return 1, 0.0, False, False, {}

    @property
    def count(self):
        self.asked += 1
        return self.asked

    def rename(self):
        self.task = f"renamed {self.steps}"
        return self.task

    def die(self):
        os.kill(os.getpid(), 9)

    def get_ready(self):
        def later():
            time.sleep(0.3)
            self.ready = True

        threading.Thread(target=later).start()

    def listen(self):
        signal.signal(signal.SIGALRM, lambda *_: self.get_ready())

    def rename_all(self):
        time.sleep(0.3)
        for one in ALL:
            one.task = "another"

class Live(gym.vector.SyncVectorEnv):
    """Is built by itself, so that all tasks share a process."""

    def step(self, actions):
        return super().step(actions)
'''
REPOSITORY = STILL + _TOLD
SUITE = f"""{REPOSITORY}
def make_env(n_envs=1, use_async_envs=False):
    kinds = (gym.vector.SyncVectorEnv, gym.vector.SyncVectorEnv, Live)
    return {{"suite": {{task: kind([Told] * n_envs) for task, kind in enumerate(kinds)}}}}
"""
READ = ("task", "kind", "steps", "episodes", "count", "asked", "absent", "late")
WAYS = [
    {"policy": {"lane": "auto"}, "num_workers": 1},
    {"policy": {"lane": "frames"}, "num_workers": 1},
    {"policy": {"lane": "auto"}, "num_workers": 2},
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("told")
    (found / "env.py").write_text(REPOSITORY)
    return found


def in_this_process() -> Any:
    names: dict[str, Any] = {"__name__": "told"}
    exec(compile(REPOSITORY, "told", "exec"), names)
    return names["make_env"](ENVS)


def done(env: gym.vector.VectorEnv[Any, Any, Any], what: str, number: int) -> Any:
    if what == "step":
        return env.step(np.array([number % 2, (number // 16) % 3, 0]))[:4]
    if what == "reset":
        return env.reset(seed=number)
    if what == "set_attr":
        return env.set_attr("task", [f"set {number}"] * ENVS)
    if what == "rename":
        return env.call("rename")
    try:
        return env.get_attr(what)
    except AttributeError:
        return "there is none"


@pytest.mark.parametrize("way", WAYS, ids=str)
def test_every_value_is_the_one_that_is_there(folder: Path, way: dict[str, Any]) -> None:
    dice = random.Random(3)
    requests = ["reset"]
    for _ in range(60):  # rounds of an evaluation, with something else in between
        names = dice.sample(READ, 3)
        for _ in range(dice.randrange(1, 8)):
            requests += ["step", *names, *dice.choices(READ, k=dice.randrange(2))]
        requests.append(dice.choice(["reset", "set_attr", "rename", "step"]))
    here = in_this_process()
    expected = [done(here, what, number) for number, what in enumerate(requests)]
    with make_env(folder, ENVS, **way) as suites:
        env = suites.env
        found = [done(env, what, number) for number, what in enumerate(requests)]
        assert_same(found, expected)
        assert env.sandbox.stats()["requests"] < len(requests) - 100  # many were not asked at all


@pytest.mark.parametrize("way", WAYS, ids=str)
def test_what_is_absent_is_asked_for_until_watched(folder: Path, way: dict[str, Any]) -> None:
    """The error is then the same, each time another one; and the first that has it is noticed."""
    with make_env(folder, ENVS, **way) as suites:
        env = suites.env
        env.reset()
        before, errors = env.sandbox.stats()["requests"], []
        for _ in range(20):
            env.step(np.zeros(ENVS, np.int64))
            with pytest.raises(AttributeError) as caught:
                env.call("late")
            errors.append(caught.value)
        assert env.sandbox.stats()["requests"] - before == 20 + 3
        assert len({id(error) for error in errors}) == 20
        assert len({repr(vars(error)) + str(error) for error in errors}) == 1
        env.step(np.array([2, 0, 0]))
        with pytest.raises(AttributeError):  # of the second sub-environment
            env.call("late")
        env.step(np.full(ENVS, 2))
        assert env.call("late") == ("task 22",) * ENVS


def test_who_waits_for_a_signal_is_not_watched(folder: Path) -> None:
    """It may come between two requests, from a timer or a child. Until then an evaluation asks for
    its task but twice: to see that it is asked for again, and to have it watched. What a thread of
    the repository changes, with no request in between, is seen."""
    with make_env(folder, ENVS, num_workers=1) as suites:
        env = suites.env
        env.reset()
        for listens in (False, True):
            if listens:
                env.call("listen")
            before = env.sandbox.stats()["requests"]
            for number in range(10):
                env.step(np.zeros(ENVS, np.int64))
                ask = env.call if number % 2 else env.get_attr
                assert ask("kind") == ("reacher",) * ENVS
            assert env.sandbox.stats()["requests"] - before == (20 if listens else 10 + 2)
        for _ in range(3):
            env.step(np.zeros(ENVS, np.int64))
            assert env.get_attr("ready") == (False,) * ENVS
        env.call("get_ready")
        while not all(env.get_attr("ready")):
            pass


@pytest.mark.parametrize("way", ["late", "closed"])
def test_a_reply_that_is_lost_says_nothing(tmp_path: Path, way: str) -> None:
    """It would have said that an environment of the same process has changed another's."""
    (tmp_path / "env.py").write_text(SUITE)
    with make_env(tmp_path, ENVS) as suites:
        env, other = suites["suite"][0], suites["suite"][1]
        for one in (env, other):
            one.reset()
        for _ in range(3):
            env.step(np.zeros(ENVS, np.int64))
            assert env.get_attr("task") == ("reach",) * ENVS
        other.call_async("rename_all")
        if way == "closed":
            other.close()
        else:
            with contextlib.suppress(WorkerTimeoutError):  # or it came already, and was read
                other.call_wait(timeout=0)

        def is_told() -> bool:
            env.step(np.zeros(ENVS, np.int64))
            return bool(env.get_attr("task") == ("another",) * ENVS)

        assert eventually(is_told)


@pytest.mark.parametrize(
    ("way", "restart", "then"),
    [(WAYS[0], "on_reset", "reach"), *((way, "transparent", "set") for way in WAYS[1:])],
    ids=str,
)
def test_fresh_runners_are_asked(
    folder: Path, way: dict[str, Any], restart: str, then: str
) -> None:
    """What those that died have said no longer counts; only who is to be, is as it was set."""
    policy = {"restart": restart, "restart_backoff_s": 0}
    with make_env(folder, ENVS, **{**way, "policy": {**policy, **way["policy"]}}) as suites:
        env = suites.env
        env.reset()
        env.set_attr("task", ["set"] * ENVS)
        for _ in range(3):
            env.step(np.zeros(ENVS, np.int64))
            assert env.get_attr("task") == ("set",) * ENVS
            assert env.get_attr("episodes") == (1,) * ENVS
        with pytest.raises(WorkerDiedError):
            env.call("die")
        env.reset()
        env.step(np.zeros(ENVS, np.int64))
        assert env.get_attr("task") == (then,) * ENVS
        assert set(env.get_attr("episodes")) <= {1, 2}


@pytest.mark.parametrize("way", WAYS[1:], ids=str)
def test_who_comes_back_in_the_midst_is_asked_anew(folder: Path, way: dict[str, Any]) -> None:
    """A shard dies in a step, and the others go on: of each, what it is now."""
    policy = {"restart": "transparent", "restart_backoff_s": 0}
    with make_env(folder, ENVS, **{**way, "policy": {**policy, **way["policy"]}}) as suites:
        env = suites.env
        env.reset(seed=0)
        env.set_attr("mortal", [False] * ENVS)
        renamed = env.call("rename")
        for _ in range(3):
            env.step(np.zeros(ENVS, np.int64))
            assert env.get_attr("task") == renamed
        env.set_attr("mortal", [True, False, False])
        *_, infos = env.step(np.zeros(ENVS, np.int64))
        fresh = infos["worker_restarted"]
        assert fresh[0]
        assert fresh.all() == (way["num_workers"] == 1)
        env.set_attr("mortal", [False] * ENVS)
        env.step(np.zeros(ENVS, np.int64))
        assert env.get_attr("task") == tuple(np.where(fresh, "reach", renamed).tolist())
