"""What it saves that finished sub-environments stand still: ``python -m benchmarks.freezing``.

The loop of LeRobot's ``rollout``: all sub-environments are stepped until the last one is done.
Their episodes have 50 to 300 steps, drawn at random, and a step computes for ``--ms``. With and
without the option that announces a rollout, in alternating turns of one run; ratios stay within a
turn. Returns and lengths of the episodes are compared, and must be equal.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks.load import load_average
from envhub_sandbox import make_env

ENVS = """
import time
import gymnasium as gym
import numpy as np

class Task(gym.Env):
    observation_space = gym.spaces.Dict(agent_pos=gym.spaces.Box(-9, 9, (4,), np.float32))
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, ms):
        self.ms = ms

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(50, 301))
        return self.seen(), {"is_success": False}

    def seen(self):
        return {"agent_pos": np.full(4, self.left / 300, np.float32)}

    def step(self, action):
        until = time.perf_counter() + self.ms / 1000
        while time.perf_counter() < until:
            pass
        self.left -= 1
        return self.seen(), 1.0, not self.left, False, {"is_success": not self.left}

def make_env(n_envs=1, use_async_envs=False, ms=0.5):
    kind = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return kind([lambda: Task(ms)] * n_envs)
"""


def rollout(env: Any, seed: int, *, freezes: bool) -> tuple[float, list[float], int]:
    """Seconds, returns of the episodes, and steps of the whole batch."""
    start = perf_counter()
    env.reset(seed=seed, options={"lerobot_new_rollout": freezes})
    done = np.zeros(env.num_envs, bool)
    returns, steps = np.zeros(env.num_envs), 0
    actions = np.zeros((env.num_envs, 2), np.float32)
    while not done.all():
        _, rewards, terminated, truncated, _ = env.step(actions)
        returns += np.where(done, 0.0, rewards)
        done |= terminated | truncated
        steps += 1
    return perf_counter() - start, returns.tolist(), steps


def measure(options: argparse.Namespace, folder: Path, use_async_envs: bool) -> str:
    """One line of results."""
    ratios, shares = [], []
    given = {"n_envs": options.envs, "use_async_envs": use_async_envs}
    given["env_kwargs"] = {"ms": options.ms}
    # one each: once a rollout was announced, an environment keeps freezing
    with make_env(str(folder), **given) as plain, make_env(str(folder), **given) as frozen:
        for turn in range(options.turns):
            ways = [(plain.env, False), (frozen.env, True)]
            found = {
                freezes: rollout(env, turn * 1000, freezes=freezes)
                for env, freezes in (ways if turn % 2 else reversed(ways))
            }
            if found[True][1:] != found[False][1:]:
                raise SystemExit(f"turn {turn}: the episodes differ")
            ratios.append(found[False][0] / found[True][0])
            shares.append(sum(found[True][1]) / (found[True][2] * options.envs))
    low, median, high = statistics.quantiles(ratios, n=4)
    name = "async" if use_async_envs else "sync"
    work = statistics.mean(shares)
    return (
        f"{name}: {median:.2f} x faster (quartiles {low:.2f} and {high:.2f}); "
        f"{work:.0%} of the steps are needed, which is {1 / work:.2f} x"
    )


def main() -> None:
    """Print the ratios."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.freezing", description=__doc__)
    parser.add_argument("--envs", type=int, default=10)
    parser.add_argument("--turns", type=int, default=12)
    parser.add_argument("--ms", type=float, default=0.5)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        os.chmod(name, 0o755)  # jails of root run as another user
        (Path(name) / "env.py").write_text(ENVS)
        for use_async_envs in (False, True):
            print(measure(options, Path(name), use_async_envs), flush=True)
    print(f"load average {load_average()}")


if __name__ == "__main__":
    main()
