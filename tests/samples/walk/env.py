"""A random walk whose every result depends on its seed, its actions and its history."""

import os
import time

import gymnasium as gym
import numpy as np


class Walk(gym.Env):
    """Action: 0 to 3 walks, 4 is slow (20 ms), 5 never returns, 6 ends the process."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = gym.spaces.Discrete(7)

    def reset(self, *, seed=None, options=None):
        """Begin somewhere."""
        super().reset(seed=seed)
        self.position, self.steps = self.np_random.normal(), 0
        return self._observe(), {}

    def step(self, action):
        """Do what the action says."""
        if action == 4:
            time.sleep(0.02)
        if action == 5:
            time.sleep(3600)
        if action == 6:
            os._exit(1)
        self.steps += 1
        self.position += (action - 1.5) * self.np_random.random()
        over = self.np_random.random() < 0.02
        info = {"is_success": bool(over)} if self.steps % 2 else {}
        return self._observe(), float(self.position), bool(over), self.steps >= 100, info

    def _observe(self):
        return np.array([self.position, self.steps, self.np_random.random()])


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    """As many walks as are asked for."""
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([Walk] * n_envs)
