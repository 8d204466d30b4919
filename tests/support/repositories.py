"""Repositories too small to be kept as folders."""

from pathlib import Path

CARTPOLES = """
import gymnasium as gym

def cartpoles(n):
    return gym.vector.SyncVectorEnv([lambda: gym.make("CartPole-v1")] * n)
"""
CARTPOLE = f"""{CARTPOLES}
def make_env(n_envs=1, use_async_envs=False):
    return cartpoles(n_envs)
"""
STILL = """
import gymnasium as gym
import numpy as np

class Still(gym.Env):
    observation_space = gym.spaces.Discrete(2)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return 0, 0.0, False, False, {}

def vector(kind, n_envs):
    return gym.vector.SyncVectorEnv([kind] * n_envs)

def make_env(n_envs=1, use_async_envs=False):
    return vector([Still, *Still.__subclasses__()][-1], n_envs)

"""
"""An environment in which nothing happens; the last class that inherits from it is made instead."""


def importing(module: str, **answers: str) -> str:
    """An ``env.py`` that imports a module, with methods that return these expressions."""
    methods = "".join(f"    def {one}(self):\n        return {answers[one]}\n" for one in answers)
    return f"""
import sys
import gymnasium as gym
import {module}

class Asked(gym.Wrapper):
{methods}
def make_env(n_envs=1, use_async_envs=False, name="CartPole-v1"):
    return gym.vector.SyncVectorEnv([lambda: Asked(gym.make(name))] * n_envs)
"""


def write_repository(folder: Path, env_py: str, **files: str) -> Path:
    """Write a repository with an ``env.py`` and other files, named with ``__`` for a dot."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "env.py").write_text(env_py)
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(text)
    return folder
