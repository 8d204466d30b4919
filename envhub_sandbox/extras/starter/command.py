"""``envhub init``: writes a new environment's repository, which loads and steps unchanged."""

from __future__ import annotations

import re
import time
from pathlib import Path
from string import Template
from typing import Annotated

import typer

from envhub_sandbox.cli.shared import options as opt
from envhub_sandbox.cli.shared.console import out, safe_line, say
from envhub_sandbox.cli.shared.exits import UsageError
from envhub_sandbox.system import extras

_NAME = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]{0,94}[A-Za-z0-9])?", re.ASCII)


@opt.with_options()
def init(
    folder: Annotated[
        Path,
        typer.Argument(metavar="NAME", help="The new folder; its last part names the repository."),
    ],
    lerobot: Annotated[
        bool,
        typer.Option(
            "--lerobot",
            help="Write an environment that LeRobot can evaluate and train on, with agent_pos and "
            "pixels as observations.",
        ),
    ] = False,
) -> None:
    """Write a new environment's repository: env.py, requirements, card, licence, test, CI workflow.

    If git is installed and the folder is in no checkout, 'git init' runs in it.

    [bold]envhub init my-env && envhub run ./my-env[/bold]
    """
    name = repository_name(folder)
    files = starter(name, time.localtime().tm_year, lerobot=lerobot)
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UsageError(f"{folder} exists and is not empty; choose another folder")
        for path, text in files.items():
            target = folder / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{folder} cannot be written: {error.strerror or error}") from error
    if make_checkout := extras.find("envhub_sandbox.extras.sources.checkout", "make_checkout"):
        make_checkout(folder)
    shown = safe_line(str(folder) if folder.is_absolute() else f"./{folder}")
    out(shown)
    say(f"Try it: envhub run {shown}. Publish it: hf upload OWNER/{name} {shown}")


def repository_name(folder: Path) -> str:
    """Returns a repository's name, from its folder. Raises ``UsageError``."""
    name = folder.absolute().name
    if not _NAME.fullmatch(name) or "--" in name or ".." in name or name.endswith(".git"):
        raise UsageError(
            f"{name!r} is not a valid name on the Hub: use letters, digits, '-', '_' and '.', with "
            "a letter or digit at both ends, and no '--' or '..'"
        )
    return name


# --- the files: an environment that loads, steps and draws as it is -------------------------------

_FILES = {
    ".gitignore": Template("""\
__pycache__/
.pytest_cache/
.venv/
"""),
    "env.py": Template('''\
"""$name: push a puck along a line to its goal.

Try it::

    envhub run . --episodes 4 --n-envs 2
"""

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import TimeLimit

WIDTH, HEIGHT = 128, 32  # pixels
NEAR = 0.05


class PuckEnv(gym.Env):
    """Observed are the puck's place and the goal's; the action is how far to push it."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}
    observation_space = $space
    action_space = gym.spaces.Box(-0.2, 0.2, (1,), np.float32)
    task_description = "push the puck to the goal"

    def __init__(self, render_mode="rgb_array"):
        self.render_mode = render_mode
        self.puck = self.goal = 0.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)  # seeds self.np_random, the only source of chance here
        self.puck, self.goal = self.np_random.uniform(-1, 1, 2)
        return self._observation(), {}

    def step(self, action):
        self.puck = float(np.clip(self.puck + action[0], -1, 1))
        distance = abs(self.puck - self.goal)
        success = bool(distance < NEAR)
        return self._observation(), -distance, success, False, {"is_success": success}

    def render(self):
        frame = np.full((HEIGHT, WIDTH, 3), 240, np.uint8)
        for place, colour in ((self.goal, (40, 160, 80)), (self.puck, (40, 60, 160))):
            column = int((place + 1) / 2 * (WIDTH - 1))
            frame[8:24, max(column - 3, 0) : column + 4] = colour
        return frame

    def _observation(self):
        return $observation


def make_env(n_envs: int = 1, use_async_envs: bool = False) -> gym.vector.VectorEnv:
    """The entry point of every environment repository."""
    vector = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv

    def one() -> gym.Env:
        return TimeLimit(PuckEnv(), max_episode_steps=50)

    return vector([one] * n_envs)
'''),
    "requirements.txt": Template("""\
# The packages that env.py imports. envhub installs their wheels where this interpreter lacks them.
gymnasium>=1.0
numpy>=1.26
"""),
    "README.md": Template("""\
---
license: mit
tags:
- reinforcement-learning
- robotics
- gymnasium
- envhub
---

# $name

What it is about, in a sentence: push a puck along a line to its goal.

| | |
| --- | --- |
| Observation | $observed |
| Action | float32 `(1,)`: how far to push, from -0.2 to 0.2 |
| Reward | minus the distance |
| Ends | at the goal (`is_success`), or after 50 steps |

```python
from envhub_sandbox import make_env

with make_env("OWNER/$name@COMMIT", n_envs=4) as suites:
    observations, infos = suites.env.reset(seed=0)
```
$evaluated
## For its authors

```sh
envhub run . --episodes 4 --n-envs 2   # plays it in a sandbox
pytest --envhub-ref .
envhub check . && hf upload OWNER/$name .
```
"""),
    "LICENSE": Template("""\
MIT License

Copyright (c) $year the authors of $name

Permission is hereby granted, free of charge, to any person obtaining a copy of this software and
associated documentation files (the "Software"), to deal in the Software without restriction,
including without limitation the rights to use, copy, modify, merge, publish, distribute,
sublicense, and/or sell copies of the Software, and to permit persons to whom the Software is
furnished to do so, subject to the following conditions:

The above copyright notice and this permission notice shall be included in all copies or substantial
portions of the Software.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT
NOT LIMITED TO THE WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND
NONINFRINGEMENT. IN NO EVENT SHALL THE AUTHORS OR COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES
OR OTHER LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR OTHERWISE, ARISING FROM, OUT OF OR IN
CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE SOFTWARE.
"""),
    "test_env.py": Template('''\
"""Run by ``pytest --envhub-ref .``: the environment plays in a sandbox."""

import numpy as np


def test_an_episode_ends_and_the_same_seed_is_the_same_episode(envhub_env):
    returns = []
    for _ in range(2):
        envhub_env.reset(seed=0)
        envhub_env.action_space.seed(0)
        total, ended = 0.0, False
        for _ in range(60):
            _, rewards, ends, cuts, _ = envhub_env.step(envhub_env.action_space.sample())
            total += float(rewards[0]) * (not ended)
            ended = bool(ended or ends[0] or cuts[0])
        assert ended
        returns.append(total)
    np.testing.assert_equal(*returns)
'''),
    ".github/workflows/check.yml": Template("""\
name: check
on: [push, pull_request]
permissions:
  contents: read
jobs:
  sandboxed:
    runs-on: ubuntu-latest
    timeout-minutes: 30
    steps:
    - uses: actions/checkout@v4
    - uses: actions/setup-python@v5
      with:
        python-version: "3.12"
    - run: pip install envhub-sandbox pytest
    # Ubuntu lets no program make user namespaces, which the strict profile needs
    - run: sudo sysctl -w kernel.apparmor_restrict_unprivileged_userns=0
    - run: envhub doctor
    - run: envhub check . --github
    - run: pytest --envhub-ref .
"""),
}

_PLACES = "np.array([self.puck, self.goal], np.float32)"
_BOX = "gym.spaces.Box(-1.0, 1.0, (2,), np.float32)"
_OBSERVED = "float32 `(2,)`: the puck's place and the goal's, from -1 to 1"
_PLAIN = {"space": _BOX, "observation": _PLACES, "observed": _OBSERVED, "evaluated": ""}
_FOR_LEROBOT = {
    "space": f"""gym.spaces.Dict(
        agent_pos={_BOX},
        pixels=gym.spaces.Box(0, 255, (HEIGHT, WIDTH, 3), np.uint8),
    )""",
    "observation": f'{{"agent_pos": {_PLACES}, "pixels": self.render()}}',
    "observed": f"`agent_pos`, {_OBSERVED}; `pixels`, uint8 `(32, 128, 3)`",
    "evaluated": """
With LeRobot:

```sh
lerobot-eval --env.discover_packages_path=envhub_sandbox.integrations.lerobot \\
    --env.type=envhub_sandbox --env.repo=OWNER/$name@COMMIT --policy.path=OWNER/POLICY
```
""",
}


def starter(name: str, year: int, *, lerobot: bool = False) -> dict[str, str]:
    """Returns the files of a new repository, by path.
    ``lerobot``: whether its observations have the keys of LeRobot's policies.
    """
    values = {"name": name, "year": str(year)}
    chosen = _FOR_LEROBOT if lerobot else _PLAIN
    values |= {key: Template(text).substitute(values) for key, text in chosen.items()}
    return {path: text.substitute(values) for path, text in _FILES.items()}
