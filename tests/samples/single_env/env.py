"""One environment, whatever ``n_envs`` says."""

import gymnasium as gym


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.Env:
    return gym.make("CartPole-v1")
