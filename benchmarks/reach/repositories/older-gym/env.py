import gym
import numpy as np


class Drift(gym.Env):
    """As environments were before 0.22."""

    metadata = {"render.modes": ["rgb_array"]}  # noqa: RUF012
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Discrete(3)

    def seed(self, seed=None):
        self.random = np.random.RandomState(seed)
        return [seed]

    def reset(self):
        self.place = self.random.uniform(-1, 1, 2).astype(np.float32)
        return self.place

    def step(self, action):
        drift = self.random.uniform(-0.1, 0.1, 2)
        self.place = (self.place + drift + (action - 1) * 0.2).astype(np.float32)
        far = bool(np.abs(self.place).max() > 1.5)
        return self.place, float(-np.abs(self.place).sum()), far, {}


def make_env(n_envs=1, use_async_envs=False):
    return gym.wrappers.TimeLimit(Drift(), 15)
