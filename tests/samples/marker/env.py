"""Leaves traces of where and how it was loaded, and uses everything a repository may bring.

At import it appends its pid to the file that ``$ENVHUB_MARKER`` names (if it sees that variable)
and to ``imported.txt`` in its working directory.
"""

from __future__ import annotations

import multiprocessing
import os
from dataclasses import dataclass, field
from pathlib import Path

import gymnasium as gym
import numpy as np

import worker  # the repository's own worker.py

from .parts import Bolt

HERE = Path(__file__).parent
for marker in (os.environ.get("ENVHUB_MARKER"), "imported.txt"):
    if marker:
        with open(marker, "a") as file:
            file.write(f"{os.getpid()}\n")


@dataclass
class Settings:
    """Postponed annotations: ``dataclass`` looks this module up in ``sys.modules``."""

    size: int = 3
    bolts: list[Bolt] = field(default_factory=list)


class Workshop(gym.Env):
    """Its attributes tell the story."""

    observation_space = gym.spaces.Box(0, 1, (3,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self) -> None:
        self.settings_repr = repr(Settings(bolts=[Bolt(4)]))
        self.own_worker = worker.WHO_AM_I
        self.import_pids = [int(line) for line in Path("imported.txt").read_text().split()]
        self.pid = os.getpid()
        self.asset_by_file = (HERE / "assets" / "hello.txt").read_text()
        self.asset_by_cwd = Path("assets/hello.txt").read_text()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(3, np.float32), {}

    def step(self, action):
        return np.ones(3, np.float32), 1.0, False, False, {}

    def child_says(self, method: str) -> tuple[int, str]:
        """Pickle a class of this repository to a child process, and its answer back."""
        with multiprocessing.get_context(method).Pool(1) as pool:
            settings = pool.apply(worker.tighten, (Settings(size=8),))
        return settings.size, type(settings).__name__


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([Workshop] * n_envs)
