"""Repositories too small to be kept as folders."""

from __future__ import annotations

from pathlib import Path

CARTPOLES = """
import gymnasium as gym

def cartpoles(n):
    return gym.vector.SyncVectorEnv([lambda: gym.make("CartPole-v1")] * n)
"""


def write_repository(folder: Path, env_py: str, **files: str) -> Path:
    """Write a repository with an ``env.py`` and other files, named with ``__`` for a dot.

    Returns:
        The folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "env.py").write_text(env_py)
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(text)
    return folder
