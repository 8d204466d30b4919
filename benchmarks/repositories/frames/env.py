"""Stacked game frames: 28 kB of uint8 in each observation, and next to no work in the game."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

SHAPE = (84, 84, 4)


class Frames(gym.Env):
    """Shows one screen after another; an episode has 1000 steps."""

    observation_space = spaces.Box(0, 255, SHAPE, np.uint8)
    action_space = spaces.Discrete(6)

    def __init__(self):
        screens = np.random.default_rng(0).integers(0, 256, (8, *SHAPE), dtype=np.uint8)
        self.screens = list(screens)
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        """Start again."""
        super().reset(seed=seed)
        self.steps = 0
        return self.screens[0], {}

    def step(self, action):
        """The next screen."""
        self.steps += 1
        return self.screens[self.steps % 8], float(action == 0), False, self.steps >= 1000, {}


def single() -> gym.Env:
    """One sub-environment."""
    return Frames()


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    """The entry point of every environment repository."""
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([single] * n_envs)
