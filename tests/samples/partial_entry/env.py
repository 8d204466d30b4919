"""``make_env`` is not a function but a ``functools.partial``."""

from functools import partial

import gymnasium as gym


def _make(env_id: str, n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([lambda: gym.make(env_id)] * n_envs)


make_env = partial(_make, env_id="CartPole-v1")
