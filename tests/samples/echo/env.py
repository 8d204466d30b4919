"""Answers every request with the token that it brought, when it is told to: so answers are known.

A delay below zero ends the process instead.
"""

import os
import time

import gymnasium as gym
import numpy as np


class Echo(gym.Env):
    """Action: ``[token, seconds to wait]``. Observation: ``[the request's token, its kind]``."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._answer(0, *(options or {"token": 0, "delay": 0}).values()), {}

    def step(self, action):
        return self._answer(1, *action), float(action[0]), False, False, {"token": action[0]}

    def echo(self, token: float, delay: float) -> float:
        """The token, after the delay."""
        return float(self._answer(2, token, delay)[0])

    def _answer(self, kind: int, token: float, delay: float):
        if delay < 0:
            os._exit(3)
        time.sleep(delay)
        return np.array([token, kind], np.float64)


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([Echo] * n_envs)
