"""SuperSuit's wrappers, skrl's wrapper of vector environments, and d3rlpy's online training."""

from typing import Any

import d3rlpy
import gymnasium as gym
import numpy as np
import supersuit
import torch
from compared import ENV, folder, report
from skrl.envs.wrappers.torch import wrap_env

from envhub_sandbox import SandboxEnv, make_env

STEPS = 200
REPOSITORY = folder()


def single(sandboxed: bool) -> Any:
    return SandboxEnv(REPOSITORY) if sandboxed else gym.make("CartPole-v1")


def with_supersuit(sandboxed: bool) -> list[Any]:
    env = supersuit.clip_reward_v0(supersuit.frame_stack_v1(single(sandboxed), 4))
    drawn = np.random.default_rng(0)
    seen = [env.reset(seed=1)[0]]
    for _ in range(STEPS):
        *result, _ = env.step(int(drawn.integers(2)))
        seen.append((*result, env.reset()[0]) if result[2] or result[3] else result)
    env.close()
    return seen


def with_skrl(sandboxed: bool) -> list[Any]:
    names: dict[str, Any] = {}
    exec(ENV, names)
    vector = make_env(REPOSITORY, n_envs=3).env if sandboxed else names["make_env"](3)
    vector.reset(seed=1)  # skrl's own reset takes no seed
    env: Any = wrap_env(vector, wrapper="gymnasium")
    torch.manual_seed(0)
    seen = [env.reset()[0]]
    seen += [env.step(torch.randint(0, 2, (3, 1)))[:4] for _ in range(STEPS)]
    env.close()
    return seen


def with_d3rlpy(sandboxed: bool) -> list[Any]:
    """What a DQN chooses after each of 200 trainings of one step."""
    d3rlpy.seed(0)
    env = single(sandboxed)
    d3rlpy.envs.seed_env(env, 1)
    dqn = d3rlpy.algos.DQNConfig(batch_size=8).create()
    buffer = d3rlpy.dataset.create_fifo_replay_buffer(limit=500, env=env)
    options = {"n_steps": STEPS, "update_start_step": 50, "n_steps_per_epoch": STEPS}
    dqn.fit_online(env, buffer, **options, logger_adapter=d3rlpy.logging.NoopAdapterFactory())
    env.close()
    states = np.random.default_rng(0).normal(size=(STEPS + 1, 4)).astype(np.float32)
    return list(dqn.predict_value(states, np.zeros(STEPS + 1, np.int64)))


if __name__ == "__main__":
    report("supersuit", STEPS, with_supersuit)
    report("skrl", STEPS, with_skrl)
    report("d3rlpy", STEPS, with_d3rlpy)
