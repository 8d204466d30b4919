"""A robot's two cameras: 1.8 MB of uint8 in each observation, a dict of two."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

SHAPE = (480, 640, 3)


class Cameras(gym.Env):
    """Shows one picture after another; an episode has 1000 steps."""

    observation_space = spaces.Dict(
        {name: spaces.Box(0, 255, SHAPE, np.uint8) for name in ("front", "wrist")}
    )
    action_space = spaces.Box(-1.0, 1.0, (6,), np.float32)

    def __init__(self):
        pictures = np.random.default_rng(0).integers(0, 256, (4, *SHAPE), dtype=np.uint8)
        self.pictures = list(pictures)
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        """Start again."""
        super().reset(seed=seed)
        self.steps = 0
        return self._seen(), {}

    def step(self, action):
        """The next pictures."""
        self.steps += 1
        return self._seen(), 0.0, False, self.steps >= 1000, {}

    def _seen(self):
        front, wrist = self.pictures[self.steps % 4], self.pictures[(self.steps + 1) % 4]
        return {"front": front, "wrist": wrist}


def single() -> gym.Env:
    """One sub-environment."""
    return Cameras()


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    """The entry point of every environment repository."""
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([single] * n_envs)
