"""A repository that is played here and in the sandbox, and what a library makes of both."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

ENV = """
import gymnasium as gym

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([lambda: gym.make("CartPole-v1")] * n_envs)
"""


def folder(env_py: str = ENV) -> str:
    made = Path(tempfile.mkdtemp(prefix="compared-"))
    made.chmod(0o755)  # jails of root run as another user
    (made / "env.py").write_text(env_py)
    return str(made)


def same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(same, one, other))
    one, other = np.asarray(one), np.asarray(other)
    return one.dtype == other.dtype and np.array_equal(one, other)


def report(what: str, steps: int, play: Callable[[bool], list[Any]]) -> None:
    """Play twice, without a sandbox and with it; prints whether all was the same."""
    here, there = play(False), play(True)
    assert len(here) == steps + 1
    if not same(here, there):
        raise SystemExit(f"{what}: the results differ")
    print(f"{what}: {steps} steps are equal")
