"""LunarLander: a physics engine (Box2D) with native memory of its own."""

import gymnasium as gym


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, autoreset_mode: str = "NextStep"
) -> gym.vector.VectorEnv:
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    envs = [lambda: gym.make("LunarLander-v3", render_mode="rgb_array")] * n_envs
    return vector(envs, autoreset_mode=autoreset_mode)
