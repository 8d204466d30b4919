"""Suites as people write them: a bare vector environment, a list, single environments."""

import gymnasium as gym


def cartpoles(n_envs: int) -> gym.vector.VectorEnv:
    return gym.vector.SyncVectorEnv([lambda: gym.make("CartPole-v1")] * n_envs)


def make_env(n_envs: int = 1, use_async_envs: bool = False):
    return {
        "bare": cartpoles(n_envs),
        "list": [cartpoles(n_envs), gym.make("MountainCar-v0")],
        "singles": {3: gym.make("Pendulum-v1")},
    }
