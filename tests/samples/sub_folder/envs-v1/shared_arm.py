"""What the tasks of this folder share."""

import gymnasium as gym
import numpy as np


class PickCube(gym.Env):
    """Close the gripper (1) at the right moment."""

    observation_space = gym.spaces.Discrete(5)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, colour: str) -> None:
        self.colour = colour

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.distance = 4
        return np.int64(self.distance), {}

    def step(self, action):
        self.distance -= 1
        picked = bool(action) and self.distance == 1
        return np.int64(self.distance), float(picked), picked, self.distance == 0, {}
