"""Tasks with names instead of numbers."""

import gymnasium as gym

TASKS = {"balance the pole": "CartPole-v1", "climb/the-hill": "MountainCar-v0"}


def make_env(n_envs: int = 1, use_async_envs: bool = False):
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return {
        "classics": {
            name: vector([lambda env_id=env_id: gym.make(env_id)] * n_envs)
            for name, env_id in TASKS.items()
        }
    }
