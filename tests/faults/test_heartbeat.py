"""A timeout says whether the worker computes, waits or is stopped."""

from __future__ import annotations

from typing import Any

import pytest

from envhub_sandbox import errors, make_env
from tests.support import inside
from tests.support.samples import sample


@pytest.mark.usefixtures("neighbour")
@pytest.mark.parametrize("lane", ["auto", "frames"])
@pytest.mark.parametrize(
    ("fault", "state"), [("cpu", "running"), ("hang", "waiting"), ("stop", "stopped")]
)
def test_timeout_tells_what_the_worker_does(fault: str, state: str, lane: str) -> None:
    """Busy, asleep and stopped are different things to whoever reads the error."""
    fails: dict[str, Any] = {"moment": "step", "fault": fault}
    with make_env(sample("faulty"), n_envs=2, env_kwargs=fails, lane=lane) as suites:
        suites.env.reset()
        suites.env.step_async([0, 1])
        with pytest.raises(errors.WorkerTimeoutError, match=state) as caught:
            suites.env.step_wait(timeout=2.0)
        assert caught.value.worker == (state,)


@pytest.mark.usefixtures("neighbour")
def test_late_reply_survives_the_question() -> None:
    """Asking how it is does not lose the reply: the same process is recovered by ``reset``."""
    with make_env(sample("echo"), lane="frames") as suites:
        env = suites.env
        env.reset()
        before = inside.loaded(env)
        env.step_async([[1.0, 0.3]])
        with pytest.raises(errors.WorkerTimeoutError):
            env.step_wait(timeout=0.05)
        env.reset(options={"token": 2.0, "delay": 0.0})
        assert inside.loaded(env) is before
