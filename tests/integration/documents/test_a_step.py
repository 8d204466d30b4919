"""The pages for those who work on it are true: which files a step runs, and what the log says."""

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_worker.protocol import messages as m
from tests.support.in_process.runner_here import RunnerHere
from tests.support.samples import SAMPLES

ACTIONS = np.zeros(2, np.int64)


@pytest.mark.parametrize(
    ("lane", "reset", "step"),
    [("auto", "> reset in shared memory", ""), ("frames", "Relay reset", "Relay step")],
)
def test_the_log_names_what_is_sent(
    caplog: pytest.LogCaptureFixture, lane: str, reset: str, step: str
) -> None:
    """In order, and a step only where it is a message."""
    caplog.set_level("DEBUG", "envhub_sandbox.messages")
    with make_env(str(SAMPLES / "cartpole"), n_envs=2, policy={"lane": lane}) as suites:
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
    assert np.array_equal(np.asarray(done.observation), observation)
