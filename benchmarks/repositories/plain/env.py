"""Two cameras that look at something plain: 1.8 MB of uint8 that shrink well on a network."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

SHAPE = (480, 640, 3)


class Plain(gym.Env):
    """A gradient and a box that moves; an episode has 1000 steps."""

    observation_space = spaces.Dict(
        {name: spaces.Box(0, 255, SHAPE, np.uint8) for name in ("front", "wrist")}
    )
    action_space = spaces.Box(-1.0, 1.0, (6,), np.float32)

    def __init__(self):
        row = np.linspace(0, 255, SHAPE[1]).astype(np.uint8)
        self.background = np.broadcast_to(row[None, :, None], SHAPE)
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        """Start again."""
        super().reset(seed=seed)
        self.steps = 0
        return self._seen(), {}

    def step(self, action):
        """The box has moved."""
        self.steps += 1
        return self._seen(), 0.0, False, self.steps >= 1000, {}

    def _seen(self):
        picture = self.background.copy()
        left = 4 * self.steps % 600
        picture[200:240, left : left + 40] = (200, 30, 30)
        return {"front": picture, "wrist": picture}


def single() -> gym.Env:
    """One sub-environment."""
    return Plain()


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    """The entry point of every environment repository."""
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([single] * n_envs)
