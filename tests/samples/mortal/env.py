"""Ends its process when an action says so; every result depends on seeds, actions and history."""

import ctypes
import os
import signal
import tempfile
import time
from pathlib import Path

import gymnasium as gym
import numpy as np

LIVE, EXIT, KILL, CRASH, RAISE, SLOW, MEMORY, SPIN = range(8)


def _once(name: str) -> bool:
    """Whether this is the first time that anybody in this jail asks."""
    try:
        Path(tempfile.gettempdir(), name).open("x").close()
    except FileExistsError:
        return False
    return True


def _end(how: int) -> None:
    if how == EXIT:
        os._exit(3)
    if how == KILL:
        os.kill(os.getpid(), signal.SIGKILL)
    if how == CRASH:
        ctypes.string_at(0)
    while how == SPIN:
        pass
    while how == MEMORY:
        MORE.append(b"x" * (16 << 20))


MORE: list[bytes] = []


class Mortal(gym.Env):
    """Observation: ``[drawn at the reset, steps since, drawn at the step]``."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = gym.spaces.Discrete(8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if options and options.get("exit"):
            os._exit(4)
        if options and options.get("exit_once") and _once("exit_once"):
            os._exit(4)
        self.drawn, self.steps = self.np_random.random(), 0
        return self._observe(), {"drawn": self.drawn}

    def step(self, action):
        _end(int(action))
        if action == RAISE:
            raise ValueError("as told")
        if action == SLOW:
            time.sleep(0.5)
        self.steps += 1
        return self._observe(), self.drawn + self.steps, False, self.steps >= 5, {"at": self.steps}

    def last_words(self):
        os._exit(5)

    def rest(self, seconds: float) -> None:
        """Take a while, asleep."""
        time.sleep(seconds)

    def hello(self) -> str:
        return "hello"

    @property
    def fixed(self) -> int:
        """What cannot be set."""
        return 2

    @property
    def drawn_so_far(self) -> float:
        """What can only be set once there was a reset."""
        return self.drawn

    @drawn_so_far.setter
    def drawn_so_far(self, value: float) -> None:
        self.drawn += value

    def _observe(self):
        return np.array([self.drawn, self.steps, self.np_random.random()])


class Whole(gym.vector.VectorEnv):
    """The same with a ``step`` of its own, which cannot be cut into shards."""

    def __init__(self, n_envs: int) -> None:
        self.inner = gym.vector.SyncVectorEnv([Mortal] * n_envs)
        self.num_envs = n_envs
        self.single_observation_space = self.inner.single_observation_space
        self.single_action_space = self.inner.single_action_space
        self.observation_space = self.inner.observation_space
        self.action_space = self.inner.action_space

    def reset(self, *, seed=None, options=None):
        return self.inner.reset(seed=seed, options=options)

    def step(self, actions):
        return self.inner.step(actions)


def make_env(n_envs: int = 1, use_async_envs: bool = False, mode="NextStep", form="plain"):
    if form == "slow" and not _once("made"):
        print("slowly", flush=True)
        time.sleep(3600)
    if form == "whole":
        return Whole(n_envs)
    plain = not use_async_envs or form == "built"
    cls = gym.vector.SyncVectorEnv if plain else gym.vector.AsyncVectorEnv
    made = cls([Mortal] * n_envs, autoreset_mode=gym.vector.AutoresetMode(mode))
    if form == "built":
        made.single_observation_space.sample()  # whoever looks into it has it built
        other = gym.vector.SyncVectorEnv([Mortal] * n_envs)
        other.reset()
        return {"suite": {"a": made, "b": other}}
    return made
