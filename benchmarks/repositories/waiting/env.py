"""A step that waits for as long as its action says, as a simulator's server or a robot may."""

import time

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Waiting(gym.Env):
    """Sleeps for so many milliseconds."""

    observation_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
    action_space = spaces.Box(0.0, 1000.0, (), np.float64)

    def reset(self, *, seed=None, options=None):
        """Start again."""
        super().reset(seed=seed)
        return np.zeros(4, np.float32), {}

    def step(self, action):
        """Wait."""
        if action:
            time.sleep(float(action) / 1e3)
        return np.zeros(4, np.float32), 0.0, False, False, {}


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    """The entry point of every environment repository."""
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([Waiting] * n_envs)
