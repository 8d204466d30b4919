"""Deep Sea Treasure: two objectives, so each reward is a vector of two."""

import gymnasium as gym
import mo_gymnasium
from mo_gymnasium.wrappers.vector import MOSyncVectorEnv


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    def one() -> gym.Env:
        return mo_gymnasium.make("deep-sea-treasure-v0", max_episode_steps=12)

    return (gym.vector.AsyncVectorEnv if use_async_envs else MOSyncVectorEnv)([one] * n_envs)
