"""CartPole, the way most authors publish an environment."""

import gymnasium as gym


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, autoreset_mode: str = "NextStep"
) -> gym.vector.VectorEnv:
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([lambda: gym.make("CartPole-v1")] * n_envs, autoreset_mode=autoreset_mode)
