"""``validate=True``: what the spaces do not hold is refused, and nothing else."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import ActionError, ObservationError
from envhub_sandbox.vector.validated import holds
from envhub_worker.protocol.lifecycle import State
from tests.support import inside
from tests.support.command_line import envhub
from tests.support.repositories import STILL, write_repository
from tests.support.samples import sample

pytestmark = pytest.mark.same_for("users")

# told by the caller how it is to leave its space, and when
_LEAVER = """
class Leaver(Still):
    observation_space = gym.spaces.Dict({"at": gym.spaces.Box(-1, 1, (2,), np.float32)})
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, value, moment):
        self.value, self.moment, self.steps = value, moment, 0

    def _seen(self, moment):
        value = self.value if moment == self.moment else 0.5
        return {"at": np.array([0.0, value], np.float32)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._seen("reset"), {}

    def step(self, action):
        self.steps += 1
        done = self.steps == 3
        return self._seen("last" if done else "step"), 0.0, done, False, {}


def make_env(n_envs=1, use_async_envs=False, value=0.5, moment="", mode="NextStep"):
    fns = [lambda: Leaver(0.5, "")] * (n_envs - 1) + [lambda: Leaver(value, moment)]
    return gym.vector.SyncVectorEnv(fns, autoreset_mode=gym.vector.AutoresetMode(mode))
"""


@pytest.fixture(scope="module")
def leaver(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A repository whose last sub-environment leaves its observation space."""
    return write_repository(tmp_path_factory.mktemp("leaver"), STILL + _LEAVER)


@pytest.mark.parametrize(
    ("lane", "value", "moment", "mode"),
    [
        ("auto", 2.0, "reset", "NextStep"),
        ("auto", float("nan"), "step", "NextStep"),
        ("auto", 2.0, "last", "SameStep"),
        ("frames", 2.0, "step", "NextStep"),
    ],
)
def test_an_observation_outside_of_its_space_is_told(
    leaver: Path, lane: str, value: float, moment: str, mode: str
) -> None:
    """Whose it is, what it is, and the environment is usable. Without it nobody minds."""
    kwargs = {"value": value, "moment": moment, "mode": mode}
    with make_env(str(leaver), 3, env_kwargs=kwargs, lane=lane) as suites:
        play(suites.env)
    with make_env(str(leaver), 3, env_kwargs=kwargs, lane=lane, validate=True) as suites:
        with pytest.raises(ObservationError, match="sub-environment 2 gave") as caught:
            play(suites.env)
        assert caught.value.index == 2
        assert not holds(suites.env.single_observation_space, caught.value.observation)
        assert str(leaver) in str(caught.value)
        assert suites.env.sandbox.stats()["state"] == "READY"


def play(env: Any) -> None:
    """An episode and a half, by both ways to step."""
    env.reset(seed=0)
    for number in range(5):
        actions = np.zeros((env.num_envs, 1), np.float32)
        if number % 2:
            env.step_async(actions)
            env.step_wait()
        else:
            env.step(actions)


def test_an_action_outside_of_its_space_is_not_sent(leaver: Path) -> None:
    with make_env(str(leaver), 2, validate=True) as suites:
        env = suites.env
        env.reset(seed=0)
        env.step(np.array([[0.25], [-1.0]]))
        for bad in (1.5, float("nan")):
            with pytest.raises(ActionError, match="sub-environment 1 is outside"):
                env.step(np.array([[0.0], [bad]], np.float32))
        assert env.sandbox.stats()["steps"] == 1


@pytest.mark.parametrize("name", ["custom_vector", "exotic_spaces", "lerobot_pendulum"])
def test_what_keeps_to_its_spaces_passes(name: str) -> None:
    """Nested spaces, spaces that are not known here, classes of the repository's own."""
    with make_env(sample(name), 2, validate=True) as suites:
        for env in [env for tasks in suites.values() for env in tasks.values()]:
            env.reset(seed=0)
            for _ in range(5):
                try:
                    actions = env.action_space.sample()
                except gym.error.CustomSpaceError:
                    break
                env.step(actions)


def test_who_drops_it_has_closed_it() -> None:
    gc.disable()
    try:
        suites = make_env(sample("pendulum"), 2, validate=True)
        env = suites.env
        env.reset(seed=0)
        session = inside.session(env)
        suites.clear()
        del suites, env
        assert session.lifecycle.state is State.CLOSED
    finally:
        gc.enable()


def test_envhub_run_validates(leaver: Path) -> None:
    kwargs = ("--env-kwargs", "value=2.0", "--env-kwargs", "moment=step")
    for validate, code in ((), 0), (("--validate",), 1):
        done = envhub("run", leaver, *kwargs, "--episodes", "1", *validate)
        assert done.returncode == code, done.stderr
    assert "outside its space: sub-environment 0" in done.stderr


_SHAPELESS = """
import gymnasium as gym
import numpy as np


class Shapeless(gym.vector.VectorEnv):
    def __init__(self, n):
        self.num_envs = n
        self.single_observation_space = gym.spaces.Dict({"at": gym.spaces.Box(-1, 1, (2,))})
        self.single_action_space = gym.spaces.Discrete(2)
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, n)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, n)

    def reset(self, *, seed=None, options=None):
        return None, {}


def make_env(n_envs=1, use_async_envs=False):
    return Shapeless(n_envs)
"""


def test_what_is_no_batch_at_all_is_told(tmp_path: Path) -> None:
    with make_env(str(write_repository(tmp_path, _SHAPELESS)), 2, validate=True) as suites:
        with pytest.raises(ObservationError, match="no batch of observations"):
            suites.env.reset()
        assert suites.env.sandbox.stats()["state"] == "READY"
