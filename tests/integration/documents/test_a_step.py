"""The pages for those who work on it are true: which files a step runs, and what the log says."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import FrameType

import numpy as np
import pytest

import envhub_sandbox
import envhub_worker
from envhub_sandbox import make_env
from envhub_worker.protocol import messages as m
from tests.support.in_process.runner_here import RunnerHere
from tests.support.samples import SAMPLES

ACTIONS = np.zeros(2, np.int64)


def test_the_page_lists_the_files_of_a_step(checkout: Path) -> None:
    """All that each step runs; and no file that there is not."""
    page = (checkout / "docs" / "internals" / "a-step.md").read_text()
    listed = set(re.findall(r"^\| `([^`]+\.py)`", page, re.MULTILINE))
    roots = [Path(one.__file__ or "").parent for one in (envhub_sandbox, envhub_worker)]
    there = [root.parent / one.removeprefix("worker/") for one in listed for root in roots]
    assert sum(one.is_file() for one in set(there)) == len(listed)
    steps: list[set[str]] = []

    def note(frame: FrameType, event: str, _: object) -> None:
        path = Path(frame.f_code.co_filename)
        for root, prefix in zip(roots, ("", "worker/"), strict=True):
            if event == "call" and path.is_relative_to(root):
                steps[-1].add(f"{prefix}{path.relative_to(root.parent)}")

    with make_env(str(SAMPLES / "cartpole"), n_envs=2, num_workers=1) as suites:
        env = suites.env
        env.reset(seed=0)
        for _ in range(20):
            steps.append(set())
            sys.setprofile(note)
            try:
                env.step(ACTIONS)
            finally:
                sys.setprofile(None)
    always = set.intersection(*steps)
    assert "envhub_sandbox/session/requests.py" in always
    assert always <= listed


@pytest.mark.parametrize(
    ("lane", "reset", "step"),
    [("auto", "> reset in shared memory", ""), ("frames", "Relay reset", "Relay step")],
)
def test_the_log_names_what_is_sent(
    caplog: pytest.LogCaptureFixture, lane: str, reset: str, step: str
) -> None:
    """In order, and a step only where it is a message."""
    caplog.set_level("DEBUG", "envhub_sandbox.messages")
    with make_env(str(SAMPLES / "cartpole"), n_envs=2, lane=lane) as suites:
        suites.env.reset(seed=0)
        suites.env.step(ACTIONS)
    said = "\n".join(caplog.messages)
    order = [said.index(one) for one in ("JailOpened", reset, step or reset, "CloseJail")]
    assert order == sorted(order)
    assert ("step" in said) == bool(step)


def test_a_runner_runs_here_for_a_debugger() -> None:
    """Without a jail, so that a breakpoint in it is met; the results are the same."""
    with RunnerHere(SAMPLES / "cartpole") as runner:
        runner.ask(m.Reset(1, [0, 1], None, None))
        done = runner.ask(m.Step(1, ACTIONS))
    with make_env(str(SAMPLES / "cartpole"), n_envs=2) as suites:
        suites.env.reset(seed=0)
        observation, *_ = suites.env.step(ACTIONS)
    assert isinstance(done, m.StepDone)
    assert np.array_equal(np.asarray(done.observation), observation)


def test_a_runner_here_leaves_nothing_to_the_next() -> None:
    """Both entry files are the module ``hub_env.env``."""
    path = list(sys.path)
    spaces = []
    for name in ("cartpole", "pendulum"):
        with RunnerHere(SAMPLES / name) as runner:
            spaces.append(type(runner.manifest.single_action_space).__name__)
    assert spaces == ["Discrete", "Box"]
    assert sys.path == path
    assert "hub_env.env" not in sys.modules
