"""How many processes a jail has ever started, those included that have ended."""

from __future__ import annotations

from pathlib import Path

import pytest

from envhub_sandbox import make_env
from tests.support.repositories import write_repository

REPOSITORY = """
import gymnasium as gym
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv


class Counting(gym.Env):
    observation_space = gym.spaces.Discrete(2)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return 0, 0.0, False, False, {}

    def started(self):
        # the pid that the kernel gave out last, in the pid namespace of who reads it
        return int(open("/proc/loadavg").read().split()[-1])


def make_env(n_envs, use_async_envs, context, tasks, looks_into_them=False):
    def task():
        if not use_async_envs:
            return SyncVectorEnv([Counting] * n_envs)
        return AsyncVectorEnv([Counting] * n_envs, context=context)

    if looks_into_them:
        for env in [task() for _ in range(tasks)]:
            env.single_action_space
            env.close()
    return {"suite": {task_id: task() for task_id in range(tasks)}}
"""


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A suite whose sub-environments tell how many pids have been used around them."""
    return write_repository(tmp_path / "counting", REPOSITORY)


def started(repository: Path, use_async_envs: bool, **env_kwargs: object) -> int:
    """The processes and threads that the first task's jail has ever had, after its reset."""
    with make_env(repository, 2, use_async_envs, num_workers=1, env_kwargs=env_kwargs) as suites:
        env = suites["suite"][0]
        env.reset(seed=0)
        return int(env.call("started")[0])


@pytest.mark.parametrize("tasks", [1, 10])
@pytest.mark.parametrize("context", ["fork", "forkserver", "spawn"])
def test_a_jail_starts_no_process_that_nobody_asked_for(
    context: str, tasks: int, repository: Path
) -> None:
    """However many tasks there are, and however the repository wanted its processes started."""
    plain = started(repository, use_async_envs=False, context=None, tasks=1)
    assert started(repository, use_async_envs=True, context=context, tasks=tasks) == plain


def test_what_the_repository_starts_is_counted(repository: Path) -> None:
    """The control: two processes for each of ten tasks, all of which have ended."""
    plain = started(repository, use_async_envs=False, context=None, tasks=1)
    arguments = {"context": "fork", "tasks": 10, "looks_into_them": True}
    assert started(repository, use_async_envs=True, **arguments) >= plain + 20
