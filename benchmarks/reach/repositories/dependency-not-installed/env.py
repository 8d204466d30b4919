import os

os.environ.setdefault("MUJOCO_GL", "disable")
import gymnasium as gym  # noqa: E402


def make_env(n_envs=1, use_async_envs=False):
    return gym.make_vec("LunarLander-v3", num_envs=n_envs, vectorization_mode="sync")
