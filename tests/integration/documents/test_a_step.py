"""The pages for those who work on it are true: which files a step runs, and what a trace prints."""

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
from tests.support.command_line import python
from tests.support.in_process.runner_here import RunnerHere
from tests.support.samples import SAMPLES

pytestmark = pytest.mark.same_for("users")

ACTIONS = np.zeros(2, np.int64)
PLAY = f"""
import sys
import numpy as np
from envhub_sandbox import make_env
for lane in sys.argv[1:]:
    with make_env({str(SAMPLES / "cartpole")!r}, n_envs=2, lane=lane) as suites:
        suites.env.reset(seed=0)
        suites.env.step(np.zeros(2, np.int64))
"""


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


STEPS = {
    "auto": "> SharedMemoryLane.send_step\n< SharedMemoryLane.wait",
    "frames": "> ServedLane.send_step\n> WorkerConnection.send Relay step",
}


def test_a_trace_names_each_message() -> None:
    for lane, step in STEPS.items():
        traced = python("-c", PLAY, lane, ENVHUB_TRACE="1").stderr.splitlines()
        lines = [re.sub(r"^\+\d+\.\d{6} MainThread ", "", line) for line in traced]
        said = "\n".join(re.sub(r" \([\d.]+ ms\)$", "", line) for line in lines)
        order = [
            "> WorkerConnection.send Hello",
            "< WorkerConnection.receive JailOpened",
            step,
            "CloseJail",
        ]
        assert said == re.sub(r"[^\x20-\x7e\n]", "", said)
        assert [said.index(one) for one in order] == sorted(said.index(one) for one in order)
    assert python("-c", PLAY, *STEPS).stderr == ""


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
