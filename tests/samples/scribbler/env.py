"""Writes into the home directory, the working directory and the temporary directory."""

import tempfile
from pathlib import Path

import gymnasium as gym


def scribble(folder: Path) -> str:
    path = folder / "scribbled.txt"
    path.write_text("I was here")
    return str(path)


class Scribbler(gym.Wrapper):
    """Its attribute ``written`` lists the files."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        folders = (Path.home(), Path.cwd(), Path(tempfile.gettempdir()))
        self.written = [scribble(folder) for folder in folders]


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    return gym.vector.SyncVectorEnv([lambda: Scribbler(gym.make("CartPole-v1"))] * n_envs)
