"""Sample Factory's batched environment, as its samplers make it of a registered one."""

from typing import Any

import gymnasium as gym
import numpy as np
from compared import folder, report
from sample_factory.algo.utils.make_env import make_env_func_batched
from sample_factory.envs.env_utils import register_env
from sample_factory.utils.attr_dict import AttrDict

from envhub_sandbox import SandboxEnv

STEPS = 200
REPOSITORY = folder()


def make(name: str, *_: Any, **__: Any) -> Any:
    """One environment; what Sample Factory calls with its configuration."""
    return SandboxEnv(REPOSITORY) if name == "sandboxed" else gym.make("CartPole-v1")


def played(sandboxed: bool) -> list[Any]:
    """A reset and steps, through the tensors that a sampler sees."""
    name = "sandboxed" if sandboxed else "here"
    config = AttrDict(env=name, env_gpu_observations=False, with_wandb=False)
    env = make_env_func_batched(config, AttrDict(worker_index=0, vector_index=0, env_id=0))
    drawn = np.random.default_rng(0)
    seen = [{key: one.numpy().copy() for key, one in env.reset(seed=1)[0].items()}]
    for _ in range(STEPS):
        observations, *rest = env.step(np.array([drawn.integers(0, 2)]))[:4]
        found = {key: one.numpy().copy() for key, one in observations.items()}
        seen.append((found, *(one.numpy().copy() for one in rest)))
    env.close()
    return seen


if __name__ == "__main__":
    for name in ("here", "sandboxed"):
        register_env(name, make)
    report("sample-factory", STEPS, played)
