"""PushT: a camera and a robot state, as imitation learning uses it."""

import os

os.environ.setdefault("MUJOCO_GL", "egl")  # gym-pusht decides by it whether there is a screen

import gym_pusht  # noqa: F401 (registers the environment)
import gymnasium as gym


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, autoreset_mode: str = "NextStep"
) -> gym.vector.VectorEnv:
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv

    def one() -> gym.Env:
        return gym.make(
            "gym_pusht/PushT-v0",
            obs_type="pixels_agent_pos",
            render_mode="rgb_array",
            max_episode_steps=20,
        )

    return vector([one] * n_envs, autoreset_mode=autoreset_mode)
