"""Asks the user to accept a licence."""

import gymnasium as gym


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    if input("Do you accept the licence? [y/N] ") != "y":
        raise SystemExit("licence not accepted")
    return gym.vector.SyncVectorEnv([lambda: gym.make("CartPole-v1")] * n_envs)
