"""The bundled examples run as their first lines say."""

import re

import numpy as np
import pytest

from envhub_sandbox import make_env
from tests.support.command_line import python
from tests.support.samples import EXAMPLES

pytestmark = pytest.mark.short


@pytest.mark.parametrize(
    ("name", "tasks", "frame"),
    [
        ("cartpole", {"hub_env": [0]}, (128, 240, 3)),
        ("catch", {"hub_env": [0]}, (64, 64, 3)),
        ("two_tasks", {"maze": [0, 1]}, (96, 96, 3)),
    ],
)
def test_example_repository(name: str, tasks: dict[str, list[int]], frame: tuple[int, ...]) -> None:
    with make_env(EXAMPLES / name, n_envs=2) as suites:
        assert {suite: list(group) for suite, group in suites.items()} == tasks
        for env in suites[next(iter(tasks))].values():
            env.reset(seed=0)
            env.step(env.action_space.sample())
            for picture in env.render():
                assert (picture.shape, picture.dtype) == (frame, np.uint8)


def test_what_an_example_needs_is_a_line_with_the_command() -> None:
    """Instead of a traceback of imports."""
    needed = ("torch", "lerobot", "ray", "stable_baselines3", "torchrl")
    code = f"import runpy, sys; sys.modules.update(dict.fromkeys({needed})); "
    scripts = sorted(EXAMPLES.glob("with_*.py"))
    assert len(scripts) > 5
    for script in scripts:
        done = python("-c", f"{code}runpy.run_path({str(script)!r})", code=1)
        [line] = done.stderr.splitlines()
        assert re.fullmatch(r"(import of|No module named) .*\. Run: pip install \S.*", line)


@pytest.mark.parametrize(
    ("script", "printed"),
    [
        ("quickstart.py", "its code is still unknown here: True"),
        ("train_random_search.py", "steps upright"),
    ],
)
def test_example_script(script: str, printed: str) -> None:
    assert printed in python(EXAMPLES / script).stdout
