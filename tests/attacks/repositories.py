"""Repositories of one environment, which differs from a plain one in what its test needs."""

from pathlib import Path

from tests.support.repositories import write_repository

PLAIN = """
import gymnasium as gym, numpy as np

class Plain(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(4)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros_like(self.observation_space.sample()), {}

    def step(self, action):
        return np.zeros_like(self.observation_space.sample()), 0.0, False, False, {}

VECTOR = gym.vector.SyncVectorEnv

def make_env(n_envs=1, use_async_envs=False):
    return VECTOR([Plain.__subclasses__()[-1]] * n_envs)

"""


def write_environment(folder: Path, source: str) -> Path:
    """A repository whose environment is the last subclass of ``Plain`` in ``source``."""
    return write_repository(folder, PLAIN + source)
