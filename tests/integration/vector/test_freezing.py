"""LeRobot's rollouts: a sub-environment whose episode has ended does nothing until the next one.
The oracle is what LeRobot's ``FreezeAfterEpisodeEnd`` does around each sub-environment;
``tests/lerobot`` compares with that class itself."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from envhub_sandbox import make_env
from tests.support.compare import assert_same
from tests.support.repositories import write_repository
from tests.support.samples import Frozen

NEW = {"lerobot_new_rollout": True}
ENVS = """
import os
import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict

class Counted(gym.Env):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    render_mode = "rgb_array"
    observation_space = Dict(
        agent_pos=Box(-9, 9, (2,), np.float64), image=Box(0, 255, (4, 4, 3), np.uint8)
    )
    action_space = Box(-1, 1, (2,), np.float32)

    def __init__(self, length):
        self.length, self.count = length, {"reset": 0, "step": 0, "render": 0}
        self.given = []

    def seen(self):
        return {"agent_pos": self.at.copy(), "image": np.full((4, 4, 3), self.steps, np.uint8)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count["reset"] += 1
        self.given.append(options)
        self.at, self.steps = self.np_random.uniform(-1, 1, 2), 0
        return self.seen(), {"is_success": False, "fresh": self.count["reset"]}

    def step(self, action):
        if action[0] == 2:
            os._exit(3)
        self.count["step"] += 1
        self.steps += 1
        self.at = self.at + action
        ended = self.steps >= self.length
        odd = self.length % 2 == 1
        return self.seen(), 1.0, ended and odd, ended and not odd, {"is_success": ended}

    def render(self):
        self.count["render"] += 1
        return np.full((4, 4, 3), self.steps + self.count["render"], np.uint8)

def make_env(n_envs=1, use_async_envs=False, mode="NextStep"):
    fns = [lambda i=i: Counted(3 + 2 * i + i % 2) for i in range(n_envs)]
    kind = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return kind(fns, autoreset_mode=gym.vector.AutoresetMode(mode))
"""


@pytest.fixture(scope="module")
def counted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A repository whose sub-environments count what they are asked for."""
    return write_repository(tmp_path_factory.mktemp("counted"), ENVS)


def oracle(n_envs: int, mode: str, kind: type = SyncVectorEnv) -> Any:
    names: dict[str, Any] = {}
    exec(ENVS, names)
    fns = [lambda i=i: Frozen(names["Counted"](3 + 2 * i + i % 2)) for i in range(n_envs)]
    return kind(fns, autoreset_mode=AutoresetMode(mode))


WAYS: dict[str, dict[str, Any]] = {
    "plain": {},
    "two workers": {"num_workers": 2, "use_async_envs": True},
    "frames": {"policy": {"lane": "frames"}},
}


@pytest.mark.parametrize(
    ("way", "mode"), [("plain", "NextStep"), ("two workers", "SameStep"), ("frames", "SameStep")]
)
def test_results_are_those_of_lerobots_wrapper(counted: Path, way: str, mode: str) -> None:
    """Over two rollouts, and a reset without the option in the middle of the second."""
    is_async = "use_async_envs" in WAYS[way]
    theirs = oracle(4, mode, AsyncVectorEnv if is_async else SyncVectorEnv)
    with make_env(counted, n_envs=4, env_kwargs={"mode": mode}, **WAYS[way]) as suites:
        ours = suites.env
        for rollout in range(2):
            assert_same(
                theirs.reset(seed=rollout, options=dict(NEW)),
                ours.reset(seed=rollout, options=dict(NEW)),
            )
            for step in range(14):
                actions = np.full((4, 2), 0.1 * step, np.float32)
                assert_same(theirs.step(actions), ours.step(actions), f"{rollout}.{step}")
                if (rollout, step) == (1, 5):
                    assert_same(theirs.reset(), ours.reset())
        counts = zip(theirs.get_attr("count"), ours.get_attr("count"), strict=True)
        assert all(theirs == ours for theirs, ours in counts)
    theirs.close()


@pytest.mark.parametrize("way", ["plain", "two workers"])
def test_what_has_ended_is_not_asked_again(counted: Path, way: str) -> None:
    """Not stepped, not reset, and drawn once, until the next rollout; which starts it anew."""
    with make_env(counted, n_envs=3, **WAYS[way]) as suites:
        env = suites.env
        env.reset(seed=0, options=NEW)
        frames = []
        for _ in range(12):
            _, rewards, *_ = env.step(np.zeros((3, 2), np.float32))
            frames.append(env.call("render"))
        assert rewards.tolist() == [0, 0, 0]
        lengths = [3, 6, 7]
        assert env.get_attr("count") == tuple(
            {"reset": 1, "step": length, "render": length} for length in lengths
        )
        for number, length in enumerate(lengths):
            last = frames[length - 1][number]
            assert all(np.array_equal(later[number], last) for later in frames[length:])
        assert np.array_equal(env.render()[0], frames[-1][0])
        env.reset(seed=1, options=NEW)
        env.step(np.zeros((3, 2), np.float32))
        assert [count["step"] for count in env.get_attr("count")] == [4, 7, 8]
        for frame, last in zip(env.call("render"), frames[-1], strict=True):
            assert not np.array_equal(frame, last)
        assert env.get_attr("given")[0] == [NEW, NEW]


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_an_episode_that_a_death_cut_stays_ended(counted: Path, mode: str) -> None:
    """Also after a restart: no reward of a further episode counts, until the next rollout."""
    options: dict[str, Any] = {**WAYS["two workers"], "policy": {"restart": "transparent"}}
    with make_env(counted, n_envs=2, env_kwargs={"mode": mode}, **options) as suites:
        env = suites.env
        env.reset(seed=0, options=NEW)
        live, dies = np.zeros((2, 2), np.float32), np.float32([[0, 0], [2, 0]])
        env.step(live)
        cut = env.step(dies)
        assert cut[4]["worker_restarted"].tolist() == [False, True]
        for step in range(3):
            observation, rewards, _, truncated, _ = env.step(live)
            # NEXT_STEP has a step for the reset, which is absorbed
            assert (rewards[1], truncated[1]) == (0, mode == "SameStep" or step % 2 == 1)
            assert np.array_equal(observation["agent_pos"][1], cut[0]["agent_pos"][1])
        assert env.get_attr("count")[1] == {"reset": 1, "step": 0, "render": 0}
        env.reset(seed=1, options=NEW)
        assert env.step(live)[1].tolist() == [1, 1]


def test_one_of_several_is_frozen_as_well(counted: Path) -> None:
    """What drives it by itself gets what the vector environment would."""
    with make_env(counted, n_envs=2) as suites:
        env = suites.env
        env.reset(seed=0, options=NEW)
        for _ in range(4):
            env.step(np.zeros((2, 2), np.float32))
        one = env.envs[0]
        frame = one.render()
        observation, reward, terminated, _, _ = one.step(np.ones(2, np.float32))
        assert (reward, terminated, observation["image"].max()) == (0.0, True, 3)
        assert one.reset()[0]["image"].max() == 3
        assert np.array_equal(one.render(), frame)
        assert env.get_attr("count")[0] == {"reset": 1, "step": 3, "render": 1}
        assert one.reset(options=NEW)[0]["image"].max() == 0
