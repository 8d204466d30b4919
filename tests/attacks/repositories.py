"""Repositories of one environment, which differs from a plain one in what its test needs."""

from pathlib import Path

from tests.support.repositories import STILL, write_repository

PLAIN = f"""{STILL}
class Plain(Still):
    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(4)

    def reset(self, **options):
        return np.zeros_like(self.observation_space.sample()), super().reset(**options)[1]

    def step(self, action):
        return np.zeros_like(self.observation_space.sample()), 0.0, False, False, {{}}

VECTOR = gym.vector.SyncVectorEnv

def make_env(n_envs=1, use_async_envs=False):
    return VECTOR([Plain.__subclasses__()[-1]] * n_envs)

"""


def write_environment(folder: Path, source: str) -> Path:
    """A repository whose environment is the last subclass of ``Plain`` in ``source``."""
    return write_repository(folder, PLAIN + source)
