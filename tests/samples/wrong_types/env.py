"""Returns anything but environments."""

import math

import gymnasium as gym

MISTAKES = {
    "none": None,
    "int": 42,
    "text": "CartPole-v1",
    "module": math,
    "class": gym.Env,
    "list of ints": [1, 2, 3],
    "empty": {},
    "suite of None": {"suite": None},
    "task of int": {"suite": {0: 42}},
    "empty suite": {"suite": {}},
    "tuple key": {("a", "b"): {0: None}},
}


def make_env(n_envs: int = 1, use_async_envs: bool = False, mistake: str = "none"):
    return MISTAKES[mistake]
