"""A benchmark: forty tasks, each a vector environment that says which processes it runs in."""

import os

import gymnasium as gym
import numpy as np


class Room(gym.Env):
    """Reach the number of the task by counting up or down."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, task: int) -> None:
        self.task = task
        self.task_description = f"count to {task}"
        self.pid = os.getpid()
        self._max_episode_steps = 30

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position, self.steps = int(self.np_random.integers(-3, 3)), 0
        return self._observe(), {}

    def step(self, action):
        self.steps += 1
        self.position += 1 if action else -1
        arrived = self.position == self.task
        info = {"is_success": arrived, "pid": self.pid}
        return self._observe(), float(arrived), arrived, self.steps >= 30, info

    def _observe(self):
        return np.array([self.position, self.task], np.float32)


def make_env(n_envs: int = 1, use_async_envs: bool = False, tasks: int = 40):
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return {"rooms": {task: vector([lambda t=task: Room(t)] * n_envs) for task in range(tasks)}}
