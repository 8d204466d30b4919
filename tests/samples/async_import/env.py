"""Takes the vector classes by name at import, before anybody could stand in for them."""

import gymnasium as gym
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    env_fns = [lambda: gym.make("CartPole-v1")] * n_envs
    if use_async_envs:
        return AsyncVectorEnv(env_fns, context="spawn", shared_memory=False)
    return SyncVectorEnv(env_fns)
