"""What an entry of the corpus is, and the repository that is written of it."""

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from envhub_sandbox.extras.judge.checks import Severity
from envhub_sandbox.extras.judge.judge import judge
from envhub_sandbox.extras.judge.settings import JudgeOptions

_BASE = """
import gymnasium as gym
import numpy as np

class Walk(gym.Env):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    render_mode = "rgb_array"
    observation_space = gym.spaces.Box(-100, 100, (2,), np.float32)
    action_space = gym.spaces.Discrete(3)
    length = 12

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.count = float(self.np_random.uniform(-1, 1)), 0
        return self.observation(), self.info()

    def step(self, action):
        self.move(action)
        self.count += 1
        return self.observation(), self.reward(), self.at > 50, self.is_late(), self.info()

    def move(self, action):
        self.at += float(self.np_random.uniform(0, 1)) * (int(action) - 1)

    def observation(self):
        return np.array([self.at, self.count], np.float32)

    def reward(self):
        return -abs(self.at)

    def is_late(self):
        return self.count >= self.length

    def info(self):
        return {}

    def render(self):
        return np.zeros((8, 8, 3), np.uint8)
"""
_MAKE = """
def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([Env] * n_envs)
"""
_NEVER_S = 600.0
_TIMEOUT_S = 120.0


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A repository, and what has to be found in it.

    Attributes:
        group: What the table in ``docs/checks.md`` counts it as.
        told: The check that finds its fault; empty for an honest one.
        also: Checks that find what follows from it.
        env: The body of its environment, beyond that of ``_BASE``.
        code: Behind that.
        head: In front of all.
        files: Others than ``env.py``, by path; of ``env.py``, all of it.
        arguments: Of ``make_env``.
        settings: How it is judged, where that is not as the others are.
        found: What is found, where that is not what has to be.
        why: Why it is not.
    """

    group: str
    told: str = ""
    also: frozenset[str] = frozenset()
    env: str = ""
    code: str = ""
    head: str = ""
    files: Mapping[str, str | bytes] = field(default_factory=dict)
    arguments: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    found: frozenset[str] | None = None
    why: str = ""

    def source(self) -> str:
        body = textwrap.indent(textwrap.dedent(self.env).strip(), "    ") or "    pass"
        code, head = textwrap.dedent(self.code), textwrap.dedent(self.head)
        make = "" if "def make_env" in code else _MAKE
        return f"{head}{_BASE}\n\nclass Env(Walk):\n{body}\n\n{code}\n{make}"

    def write(self, folder: Path) -> Path:
        papers = {"README.md": "# Walk\n", "LICENSE": "MIT\n", "env.py": self.source()}
        for name, text in {**papers, **self.files}.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return folder

    def judged(self, folder: Path) -> dict[str, str]:
        """What is found, by check; notes are left out of an honest one."""
        timeouts = dict.fromkeys(("call_s", "reset_s", "step_s"), _TIMEOUT_S)
        # most faults show in one environment, which is played in one process less
        several = not self.told or self.told == "workers" or self.group == "vectors"
        arguments = {"n_envs": 2 if several else 1, "timeouts": timeouts, **self.arguments}
        settings = {"steps": 30, "resets": 2, "slow_step_s": _NEVER_S, **self.settings}
        asked = JudgeOptions(reference=str(self.write(folder)), arguments=arguments, **settings)
        least = Severity.NOTE if self.told else Severity.WARNING
        # few are meant for LeRobot: the note that says so is of no concern here
        return {one.id: one.text for one in judge(asked).failures(least, allowed={"lerobot"})}

    @property
    def right(self) -> frozenset[str]:
        return frozenset({self.told, *self.also} - {""})

    @property
    def expected(self) -> frozenset[str]:
        """The checks that do."""
        return self.right if self.found is None else self.found
