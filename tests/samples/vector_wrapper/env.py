"""A vector environment inside a vector wrapper, which has an attribute of its own."""

import gymnasium as gym
import numpy as np


class Halve(gym.vector.VectorRewardWrapper):
    """Half the reward."""

    factor = 0.5

    def rewards(self, rewards):
        return np.asarray(rewards * self.factor, np.float32)


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return Halve(vector([lambda: gym.make("CartPole-v1")] * n_envs))
