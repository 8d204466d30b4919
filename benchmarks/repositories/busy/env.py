"""A step that computes for 2 ms: cores are what counts."""

import time

import gymnasium as gym
import numpy as np
from gymnasium import spaces

STEP_NS = 2_000_000


class Busy(gym.Env):
    """Computes for 2 ms of processor time, not of wall time: losing the core is no progress."""

    observation_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        """Start again."""
        super().reset(seed=seed)
        return np.zeros(4, np.float32), {}

    def step(self, action):
        """Compute."""
        until = time.thread_time_ns() + STEP_NS
        while time.thread_time_ns() < until:
            pass
        return np.zeros(4, np.float32), 0.0, False, False, {}


def single() -> gym.Env:
    """One sub-environment."""
    return Busy()


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    """The entry point of every environment repository."""
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([single] * n_envs)
