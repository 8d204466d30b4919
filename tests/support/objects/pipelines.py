"""Steps of which several are on their way, and the same steps one by one."""

import warnings
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from envhub_sandbox.errors import RemoteEnvError
from tests.support.repositories import STILL, write_repository

_REPOSITORY = """
import warnings

class Changing(Still):
    observation_space = gym.spaces.Box(-np.inf, np.inf, (SIZE,), np.float32)
    action_space = gym.spaces.Discrete(7)

    def __init__(self):
        self.count = 0

    def seen(self):
        return np.arange(self.count, self.count + SIZE, dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.seen(), {"at": self.count}

    def step(self, action):
        self.count += 1
        infos = [
            {},
            {"count": self.count},
            {"count": self.count / 2},
            {"other": self.count, "count": self.count, "odd": self.count % 2 == 1},
            {"said": "x" * 200_000 + str(self.count)},
        ]
        if action == 5:
            raise ValueError(f"no, at {self.count}")
        if action == 6:
            warnings.warn(f"at {self.count}")
        info = infos[int(action) % 5]
        return self.seen(), float(self.count), self.count % 17 == 0, False, info
"""
_DEPTHS = (0, 0, 3, 0, 2, 2, 0, 0, 0, 5, 1, 1, 4, 0, 16, 0, 0)
"""How many steps are on their way, from one part of a run to the next; 0: ``step``."""
_STEPS = 12
"""Of each part, of which two are of each kind: no infos, columns, other columns, large ones..."""


def changing(folder: Path, size: int) -> str:
    """A repository whose infos change from step to step, as its actions say."""
    return str(write_repository(folder, STILL + _REPOSITORY.replace("SIZE", str(size))))


def one_by_one(env: Any) -> list[Any]:
    return [_came(partial(env.step, some)) for part in _actions(env) for some in part]


def several_at_once(env: Any, look: Callable[[], object] = lambda: None) -> list[Any]:
    """The same steps; of most parts, several are sent before the first is received."""
    came = []
    for depth, part in zip(_DEPTHS, _actions(env), strict=True):
        if not depth:
            came += [_came(partial(env.step, some)) for some in part]
        left, owed = deque(part if depth else ()), 0
        while left or owed:
            while left and owed < depth:
                env.send(left.popleft())
                owed += 1
            came.append(_came(lambda: tuple(env.recv(env.num_envs))[:5]))
            owed -= 1
        look()
    return came


def _actions(env: Any) -> list[Any]:
    rng = np.random.default_rng(7)
    return [rng.integers(0, 7, (_STEPS, env.num_envs)) for _ in _DEPTHS]


def _came(step: Callable[[], Any]) -> Any:
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            came = step()
        except RemoteEnvError as error:
            came = str(error).partition("\n")[0]
    return came, sorted(str(one.message).partition("\n")[0] for one in warned)
