"""A suite of light tasks, each a vector environment; or of heavy ones, as simulators are."""

from __future__ import annotations

import sys
import time

import gymnasium as gym
import numpy as np

STEPS = 60
CONSTRUCTION_S = 1.0


class Reach(gym.Env):
    """Moves a point; every task has another target."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012

    def __init__(self, task: int, heavy: bool = False) -> None:
        self.observation_space = gym.spaces.Dict(
            {"agent_pos": gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)}
        )
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
        self.target = np.array([np.cos(task), np.sin(task)], np.float32)
        self.task = self.task_description = f"reach {task}"
        self._max_episode_steps = STEPS
        if heavy:
            import simulator  # noqa: F401 - only for what it costs

            until = time.process_time() + CONSTRUCTION_S
            while time.process_time() < until:
                pass

    def reset(self, *, seed=None, options=None):
        """A random place."""
        super().reset(seed=seed)
        self.place = self.np_random.normal(size=2).astype(np.float32)
        self.steps = 0
        return self._observe(), {"is_success": False}

    def step(self, action):
        """A step of at most 0.05 each way."""
        self.place = self.place + 0.05 * np.asarray(action, np.float32)
        self.steps += 1
        distance = float(np.linalg.norm(self.target - self.place))
        success = distance < 0.1
        return self._observe(), -distance, False, self.steps >= STEPS, {"is_success": success}

    def _observe(self):
        return {"agent_pos": np.concatenate([self.place, self.target])}


def make_env(
    n_envs: int = 1,
    use_async_envs: bool = False,
    tasks: int = 10,
    heavy: bool = False,
    packages: str = "",
):
    """A mapping of tasks, as LeRobot expects it; ``packages`` is where the simulator lies."""
    if packages:
        sys.path.append(packages)
    # what is heavy is so once a task, as where sub-environments share a simulator
    kind = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv

    def maker(task: int, index: int):
        return lambda: Reach(task, heavy and index == 0)

    return {"reach": {task: kind([maker(task, i) for i in range(n_envs)]) for task in range(tasks)}}
