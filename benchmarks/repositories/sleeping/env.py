"""A step that waits 2 ms for something else, as a simulator's server or a robot: waits overlap."""

import time

import gymnasium as gym
import numpy as np
from gymnasium import spaces

STEP_S = 0.002


class Sleeping(gym.Env):
    """Sleeps for 2 ms."""

    observation_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        """Start again."""
        super().reset(seed=seed)
        return np.zeros(4, np.float32), {}

    def step(self, action):
        """Wait."""
        time.sleep(STEP_S)
        return np.zeros(4, np.float32), 0.0, False, False, {}


def single() -> gym.Env:
    """One sub-environment."""
    return Sleeping()


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    """The entry point of every environment repository."""
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([single] * n_envs)
