"""Where the environment is."""

import gymnasium as gym
import numpy as np


class Plant(gym.Env):
    """Water it (1) or not (0)."""

    observation_space = gym.spaces.Box(0, np.inf, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.height = np.ones(1, np.float32)
        return self.height.copy(), {}

    def step(self, action):
        self.height += action
        return self.height.copy(), float(action), bool(self.height > 5), False, {}
