"""Environments whose steps end when a test says so, and not when time does."""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from tests.support.repositories import STILL, write_repository
from tests.support.started import started

_REPOSITORY = """
import os
import time

class Gated(Still):
    \"\"\"A step waits until there is a file of this name; its infos may be large.

    What it gives is how many steps it has made since it was made, and what it was seeded with.
    \"\"\"

    observation_space = gym.spaces.Box(-1, 2**40, (2,), np.int64)
    action_space = gym.spaces.MultiDiscrete([1000, 4])

    def __init__(self):
        self.steps = 0
        self.seeded = -1

    def seen(self):
        return np.array([self.steps, self.seeded])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.seeded = seed
        gate = (options or {}).get("gate", 0)
        while gate and not os.path.exists(f"{GATES}/{gate}"):
            time.sleep(0.001)
        return self.seen(), {"options": repr(options)}

    def step(self, action):
        gate, what = np.asarray(action).tolist()
        while gate and not os.path.exists(f"{GATES}/{gate}"):
            time.sleep(0.001)
        self.steps += 1
        if what == 2:
            raise ValueError(f"no, at gate {gate}")
        if what == 3:
            os._exit(1)
        return self.seen(), float(gate), False, False, {"said": "x" * (200_000 if what else 1)}

def make_env(n_envs=1, use_async_envs=False, autoreset_mode="NextStep"):
    cls = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return cls([Gated] * n_envs, autoreset_mode=gym.vector.AutoresetMode(autoreset_mode))
"""
LARGE, RAISE, DIE = 1, 2, 3
"""What the second number of an action has a step do."""


class Gates:
    """The gates, and environments before them, which are closed by ``stack``."""

    def __init__(self, folder: Path, stack: ExitStack, **options: Any) -> None:
        self._folder, self._options, self._stack = folder, options, stack
        (folder / "gates").mkdir()
        text = f"{STILL}{_REPOSITORY}".replace("{GATES}", str(folder / "gates"))
        self.repository = write_repository(folder / "repository", text)

    def env(self, count: int = 1, **options: Any) -> Any:
        options = {**self._options, **options}
        policy = {"readable": [str(self._folder / "gates")], **options.pop("policy", {})}
        made = started(self.repository, count, policy=policy, **options)
        return self._stack.enter_context(made)

    def open(self, *gates: int) -> None:
        """The steps that wait for these end."""
        for gate in gates:
            (self._folder / "gates" / str(gate)).touch()


def send(env: Any, *gates: int, ids: Any = None, what: int = 0) -> None:
    env.send(np.array([[gate, what] for gate in gates]), ids)


def ids(received: Any) -> list[int]:
    return received.env_ids.tolist()
