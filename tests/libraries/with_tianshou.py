"""Tianshou's own vectors of single environments, and its collector on them."""

from typing import Any

import gymnasium as gym
import numpy as np
from compared import folder, report
from tianshou.env import DummyVectorEnv, SubprocVectorEnv

from envhub_sandbox import SandboxEnv

COUNT, STEPS = 3, 200
REPOSITORY = folder()


def make(sandboxed: bool) -> Any:
    return SandboxEnv(REPOSITORY) if sandboxed else gym.make("CartPole-v1")


def played(kind: Any, sandboxed: bool) -> list[Any]:
    """A reset and steps, each sub-environment reset where its episode ends."""
    envs = kind([lambda: make(sandboxed)] * COUNT)
    envs.seed([1, 2, 3])
    drawn = np.random.default_rng(0)
    seen = [envs.reset()[0]]
    for _ in range(STEPS):
        observations, rewards, ends, cuts, _ = envs.step(drawn.integers(0, 2, COUNT))
        over = np.flatnonzero(ends | cuts)
        if len(over):
            observations[over] = envs.reset(over)[0]
        seen.append((observations.copy(), rewards, ends, cuts))
    envs.close()
    return seen


if __name__ == "__main__":
    for kind in (DummyVectorEnv, SubprocVectorEnv):
        report(f"tianshou {kind.__name__}", STEPS, lambda sandboxed, k=kind: played(k, sandboxed))
