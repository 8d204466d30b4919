"""A vector environment that steps all its members with one numpy expression."""

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv


class Swarm(VectorEnv):
    """Particles on a line; each wants to be at zero."""

    metadata = {"render_fps": 25, "autoreset_mode": AutoresetMode.DISABLED}  # noqa: RUF012
    render_mode = "rgb_array"

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
        self.single_action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (num_envs, 1), np.float64)
        self.action_space = gym.spaces.Box(-1, 1, (num_envs, 1), np.float32)
        self.hub_config = {"name": "swarm", "gains": [0.5, 2.0], "limits": {"speed": 1}}
        self.friction = 0.0
        self.initialized = False

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.normal(size=(self.num_envs, 1))
        return self.x.copy(), {"spread": float(np.ptp(self.x))}

    def step(self, actions):
        self.x += actions * (1 - self.friction)
        distance = np.abs(self.x[:, 0])
        done = distance < 0.05
        return self.x.copy(), -distance, done, np.zeros_like(done), {"distance": distance}

    def render(self):
        return tuple(np.full((2, 2, 3), i, np.uint8) for i in range(self.num_envs))

    def initialize(self, friction: float = 0.1) -> float:
        """Some simulators want to be told before they begin."""
        self.friction, self.initialized = friction, True
        return self.friction


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> VectorEnv:
    return Swarm(n_envs)
