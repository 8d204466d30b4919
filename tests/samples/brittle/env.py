"""Dies when its luck runs out: when that is, only the seed and the actions say."""

import ctypes
import os

import gymnasium as gym
import numpy as np


def memory() -> None:
    kept = []
    while True:
        kept.append(b"x" * (16 << 20))


ENDINGS = {
    "exit": lambda: os._exit(9),
    "segfault": lambda: ctypes.string_at(0),
    "memory": memory,
    "none": lambda: None,
}
ACTIONS = {
    "array": gym.spaces.Box(-1, 1, (2,), np.float32),
    "dict": gym.spaces.Dict(
        {"push": gym.spaces.Box(-1, 1, (2,), np.float32), "gear": gym.spaces.Discrete(3)}
    ),
    "text": gym.spaces.Tuple([gym.spaces.Text(8), gym.spaces.Discrete(3)]),
}


class Brittle(gym.Env):
    """Observation: the luck that is left. Each step, reset and call takes some of it away."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def __init__(self, ending: str, actions: str) -> None:
        self.ending, self.action_space = ENDINGS[ending], ACTIONS[actions]
        self.weight = 1.0
        self.luck = 0.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.luck = 20.0
        self._spend(float((options or {}).get("toll", 0)))
        return self._observed(), {}

    def step(self, action):
        self._spend(self._effort(action) * self.np_random.random())
        return self._observed(), self.luck, bool(self.np_random.random() < 0.2), False, {}

    def borrow(self, amount: float = 0.0) -> float:
        """Something to call."""
        self.luck += amount
        return self.luck

    def _effort(self, action) -> float:
        if isinstance(action, dict):
            return float(np.abs(action["push"]).sum()) + float(action["gear"])
        if isinstance(action, tuple):
            return len(action[0]) / 4 + float(action[1])
        return float(np.abs(action).sum())

    def _spend(self, effort: float) -> None:
        self.luck -= self.weight * effort
        if self.luck < 0:
            print(f"no luck: {self.luck!r}", flush=True)
            self.ending()

    def _observed(self):
        return np.array([self.luck])


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, ending: str = "exit", actions: str = "array"
):
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return vector([lambda: Brittle(ending, actions) for _ in range(n_envs)])
