"""Pendulum: continuous actions, and short episodes that are only ever truncated."""

import gymnasium as gym


def make_env(
    n_envs: int = 1,
    use_async_envs: bool = False,
    autoreset_mode: str = "NextStep",
    max_episode_steps: int = 25,
) -> gym.vector.VectorEnv:
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    envs = [lambda: gym.make("Pendulum-v1", max_episode_steps=max_episode_steps)] * n_envs
    return vector(envs, autoreset_mode=autoreset_mode)
