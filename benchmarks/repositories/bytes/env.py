"""Observations of any size: how the cost of a step grows with their bytes."""

import functools

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Bytes(gym.Env):
    """Shows one of two arrays after the other; an episode has 1000 steps."""

    action_space = spaces.Discrete(2)

    def __init__(self, size):
        self.observation_space = spaces.Box(0, 255, (size,), np.uint8)
        values = np.random.default_rng(0).integers(0, 256, (2, size), dtype=np.uint8)
        self.values = list(values)
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        """Start again."""
        super().reset(seed=seed)
        self.steps = 0
        return self.values[0], {}

    def step(self, action):
        """The other array."""
        self.steps += 1
        return self.values[self.steps % 2], 0.0, False, self.steps >= 1000, {}


def single(size: int = 64) -> gym.Env:
    """One sub-environment."""
    return Bytes(size)


def make_env(n_envs: int = 1, use_async_envs: bool = False, size: int = 64) -> gym.vector.VectorEnv:
    """The entry point of every environment repository."""
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([functools.partial(single, size)] * n_envs)
