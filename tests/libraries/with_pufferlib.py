"""PufferLib's emulation of an environment, and its serial vector of such."""

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pufferlib.emulation
import pufferlib.vector
from compared import folder, report

from envhub_sandbox import SandboxEnv

COUNT, STEPS = 3, 200
REPOSITORY = folder()


def make(sandboxed: bool) -> Any:
    creator = partial(SandboxEnv, REPOSITORY) if sandboxed else partial(gym.make, "CartPole-v1")
    return pufferlib.emulation.GymnasiumPufferEnv(env_creator=creator)


def played(sandboxed: bool) -> list[Any]:
    """A reset and steps of its vector, which resets what has ended."""
    creator = partial(make, sandboxed)
    envs = pufferlib.vector.make(creator, backend=pufferlib.vector.Serial, num_envs=COUNT)
    drawn = np.random.default_rng(0)
    seen = [np.array(envs.reset(seed=1)[0])]
    for _ in range(STEPS):
        result = envs.step(drawn.integers(0, 2, COUNT))[:4]
        seen.append(tuple(np.array(one) for one in result))
    envs.close()
    return seen


if __name__ == "__main__":
    report("pufferlib emulation", STEPS, played)
