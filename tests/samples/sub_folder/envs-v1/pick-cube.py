"""A file that no ``import`` statement could name, in a folder that none could either."""

from pathlib import Path

import gymnasium as gym
import shared_arm  # next to this file

COLOUR = (Path(__file__).parent / "assets" / "colour.txt").read_text().strip()


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([lambda: shared_arm.PickCube(COLOUR)] * n_envs)
