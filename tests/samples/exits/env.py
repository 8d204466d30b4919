"""Ends its process, at the moment it is told to."""

import os
import signal
import sys

import gymnasium as gym
import numpy as np

ENDINGS = {
    "exit": lambda: os._exit(7),
    "sys.exit": lambda: sys.exit(8),
    "kill": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "segfault": lambda: os.kill(os.getpid(), signal.SIGSEGV),
}


class Fragile(gym.Env):
    """``when``: ``"make"``, ``"reset"``, ``"step"`` or ``"close"``."""

    observation_space = gym.spaces.Box(0, np.inf, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, when: str, ending: str) -> None:
        self.when, self.ending = when, ENDINGS[ending]

    def reset(self, *, seed=None, options=None):
        self._maybe("reset")
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        if action == 1:
            self._maybe("step")
        return np.full(1, self.steps, np.float32), 0.0, False, False, {}

    def close(self):
        self._maybe("close")

    def _maybe(self, moment: str) -> None:
        if self.when == moment:
            self.ending()


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, when: str = "step", ending: str = "exit"
) -> gym.vector.VectorEnv:
    if when == "make":
        ENDINGS[ending]()
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([lambda: Fragile(when, ending)] * n_envs)
