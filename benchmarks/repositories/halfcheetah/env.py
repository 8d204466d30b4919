"""HalfCheetah: some 50 us of native physics, and an info of four floats in every step."""

import gymnasium as gym


def single() -> gym.Env:
    """One sub-environment."""
    return gym.make("HalfCheetah-v5")


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    """The entry point of every environment repository."""
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([single] * n_envs)
