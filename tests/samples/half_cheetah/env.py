"""HalfCheetah: MuJoCo, float64 observations, an info in every step, frames from a GL context."""

import os

os.environ.setdefault("MUJOCO_GL", "egl")  # a screen is not needed

import gymnasium as gym


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, autoreset_mode: str = "NextStep"
) -> gym.vector.VectorEnv:
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv

    def one() -> gym.Env:
        return gym.make(
            "HalfCheetah-v5", render_mode="rgb_array", width=64, height=48, max_episode_steps=40
        )

    return vector([one] * n_envs, autoreset_mode=autoreset_mode)
