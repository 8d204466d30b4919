"""``python -m benchmarks reach``: what it tries, and how it compares."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks.reach import control
from benchmarks.reach.cases import cases
from envhub_sandbox.dependencies.declared import declared

CASES = cases()
COUNTER = """
import gymnasium as gym
import numpy as np

class Counter(gym.Env):
    observation_space = gym.spaces.Dict({"n": gym.spaces.Box(0, 99, (2,), np.float32)})
    action_space = gym.spaces.Tuple((gym.spaces.Discrete(3), gym.spaces.Text(3)))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n = float(self.np_random.integers(9))
        return {"n": np.array([self.n, 0])}, {}

    def step(self, action):
        self.n += action[0] + len(action[1])
        return {"n": np.array([self.n, 1])}, self.n, self.n > 9, False, {}

def make_env(n_envs=1, use_async_envs=False):
    return VECTOR
"""


def test_there_are_as_many_as_it_says(tmp_path: Path) -> None:
    """At least forty packages, twenty repositories and a dozen of them in CI.

    Each has an entry file that is Python; what CI tries declares what it needs.
    """
    kinds = [case.kind for case in CASES.values()]
    assert kinds.count("package") >= 40
    assert kinds.count("repository") >= 20
    assert sum(case.quick for case in CASES.values()) >= 10
    for name, case in CASES.items():
        source = case.files[case.entry].decode()
        assert "make_env" in source, name
        compile(source, name, "exec")
        if case.quick:
            case.write(tmp_path / name)
            found = declared(tmp_path / name, case.entry)
            assert found is not None, name
            assert found.wanted, name


@pytest.mark.parametrize(
    "vector", ["Counter()", "{'a': [Counter()]}", "gym.vector.SyncVectorEnv([Counter])"]
)
def test_the_control_gives_what_gymnasium_gives(vector: str, tmp_path: Path) -> None:
    """By hand or as a vector: each line as of ``SyncVectorEnv`` here, in a process of its own."""
    (tmp_path / "env.py").write_text(COUNTER.replace("VECTOR", vector))
    scope: dict[str, Any] = {}
    exec(COUNTER.replace("VECTOR", "gym.vector.SyncVectorEnv([Counter])"), scope)
    env = scope["make_env"]()
    env.action_space.seed(3)
    actions = [env.action_space.sample() for _ in range(12)]
    (tmp_path / "actions.json").write_text(json.dumps([control.plain(one) for one in actions]))
    expected = [control.line(env.reset(seed=control.SEED)[0])]
    expected += [control.line(*env.step(one)[:4]) for one in actions]
    assert any(line.endswith("[1, 0]") for line in expected)
    words = [str(tmp_path), "env.py", str(tmp_path / "actions.json"), str(tmp_path / "found")]
    subprocess.run([sys.executable, control.__file__, *words], check=True, timeout=120)
    assert (tmp_path / "found").read_text().splitlines() == expected
