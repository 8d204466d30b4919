"""All sub-environments in one VectorEnv of the repository's own, as simulators on a GPU are."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Batch(gym.vector.VectorEnv):
    """Shows one of two batches after the other; no episode ends."""

    def __init__(self, num_envs, size):
        self.num_envs = num_envs
        self.single_observation_space = spaces.Box(0, 255, (size,), np.uint8)
        self.single_action_space = spaces.Discrete(2)
        self.observation_space = spaces.Box(0, 255, (num_envs, size), np.uint8)
        self.action_space = spaces.MultiDiscrete([2] * num_envs)
        shape = (2, num_envs, size)
        self.values = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        """Start again."""
        self.steps = 0
        return self.values[0], {}

    def step(self, actions):
        """The other batch."""
        self.steps += 1
        ended = np.zeros((2, self.num_envs), np.bool_)
        return self.values[self.steps % 2], np.zeros(self.num_envs), ended[0], ended[1], {}


def make_env(n_envs: int = 1, use_async_envs: bool = False, size: int = 256) -> Batch:
    """The entry point of every environment repository."""
    return Batch(n_envs, size)
