"""An environment that fills the same mappings and arrays again and again.
What arrives is what the repository's own vector environment gives, whose ``SyncVectorEnv`` takes
infos when it has them, and refers to a ``final_obs``; and the end of a single environment's episode
is the end."""

import contextlib
import importlib.util
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import SandboxEnv, make_env
from tests.support.compare import assert_same
from tests.support.repositories import write_repository

_ENV = """
import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

OF_ALL = {"flat": {"a": 0, "b": 0.0}, "nested": {"a": np.zeros(2), "in": {"c": np.zeros(1)}}}

class Reuses(gym.Env):
    observation_space = gym.spaces.Dict(b=gym.spaces.Box(-99, 99, (2,)), n=gym.spaces.Discrete(99))
    action_space = gym.spaces.Discrete(2)

    def __init__(self, length, of_all=None):
        self.length = length
        self.observation = {"b": np.zeros(2, np.float32), "n": 0}
        own = {"a": np.zeros(2), "in": {"c": np.zeros(1)}, "masked": np.ma.masked_array([0], [1])}
        own["element"] = np.ma.masked
        own["mixed"] = 0 if length == 2 else 0.0  # of which workers make different columns
        self.info = OF_ALL.get(of_all, own)

    def filled(self, value):
        self.observation["b"][:] = value
        self.observation["n"] = abs(value)
        for part in (self.info, self.info.get("in", {})):
            for key, old in part.items():
                if isinstance(old, np.ndarray) and old.ndim:
                    old[:] = value
                elif isinstance(old, (int, float)):
                    part[key] = type(old)(value)
        return self.observation

    def reset(self, *, seed=None, options=None):
        self.now = 0
        return self.filled(-self.length), self.info

    def step(self, action):
        self.now += 1
        value = 10 * self.now + self.length
        return self.filled(value), float(value), self.now == self.length, False, self.info

def make_env(n_envs=1, use_async_envs=False, mode="SameStep", of_all=None):
    kind = AsyncVectorEnv if use_async_envs else SyncVectorEnv
    return kind([lambda i=i: Reuses(2 + i, of_all) for i in range(n_envs)], autoreset_mode=mode)
"""


_TEXTS = "masked", "element"
"""What arrives as a text from a single environment."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_repository(tmp_path_factory.mktemp("reuses"), _ENV)


def _here(folder: Path) -> Any:
    spec = importlib.util.spec_from_file_location("reuses", folder / "env.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _played(env: Any) -> list[Any]:
    results = [deepcopy(env.reset())]
    results += [deepcopy(env.step(np.zeros(3, int))) for _ in range(7)]
    env.close()
    return results


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
@pytest.mark.parametrize("of_all", [None, "flat", "nested"])
@pytest.mark.parametrize("options", [{}, {"policy": {"lane": "frames"}}, {"copy": False}], ids=str)
def test_one_process(folder: Path, mode: str, of_all: str | None, options: dict[str, Any]) -> None:
    """Also where sub-environments fill the same objects, as they do in one process."""
    kwargs = {"mode": mode, "of_all": of_all}
    expected = _played(_here(folder).make_env(3, **kwargs))
    with make_env(folder, n_envs=3, env_kwargs=kwargs, **options) as suites:
        assert_same(expected, _played(suites.env))


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_several_processes(folder: Path, mode: str) -> None:
    """However many: what is asynchronous gives what ``AsyncVectorEnv`` does."""
    expected = _played(_here(folder).make_env(3, True, mode=mode))
    options: Any = {"n_envs": 3, "use_async_envs": True, "env_kwargs": {"mode": mode}}
    for workers, lane in ((1, "auto"), (2, "frames"), (3, "auto")):
        with make_env(folder, num_workers=workers, policy={"lane": lane}, **options) as suites:
            assert_same(expected, _played(suites.env), f"{workers} {lane}")


@pytest.mark.parametrize("lane", ["auto", "frames"])
def test_the_end_of_a_single_environment_is_the_end(folder: Path, lane: str) -> None:
    """In a vector environment that resets in the same step, which a ``gymnasium.Env`` does not."""
    here = _here(folder).Reuses(2)
    for name in _TEXTS:
        del here.info[name]
    with contextlib.closing(SandboxEnv(folder, policy={"lane": lane})) as there:
        for _ in range(3):
            for env in (here, there):
                env.reset()
            for _ in range(2):
                expected, result = deepcopy(here.step(0)), there.step(0)
                for name in _TEXTS:
                    del result[4][name]
                assert_same(expected[1:], result[1:])
                assert_same(expected[0]["b"], result[0]["b"])
