"""What a worker does, and what confines it, is told as it is."""

from pathlib import Path
from typing import Any

import psutil
import pytest

from envhub_sandbox import errors, make_env
from tests.support import inside
from tests.support.processes import eventually, halted
from tests.support.samples import sample
from tests.support.started import started


@pytest.mark.usefixtures("neighbour")
@pytest.mark.parametrize(
    ("fault", "state", "there", "lane"),
    [
        ("cpu", "running", {psutil.STATUS_RUNNING}, "auto"),
        ("hang", "waiting", {psutil.STATUS_SLEEPING}, "frames"),
        ("stop", "stopped", {psutil.STATUS_STOPPED}, "auto"),
    ],
)
def test_timeout_tells_what_the_worker_does(
    fault: str, state: str, there: set[str], lane: str, tmp_path: Path
) -> None:
    """Busy, asleep and stopped are different things to whoever reads the error."""
    fails: dict[str, Any] = {"moment": "step", "fault": fault}
    output = tmp_path / "output"
    policy = {"output": str(output), "lane": lane}
    with started(sample("faulty"), n_envs=2, env_kwargs=fails, policy=policy, seed=None) as env:
        [runner] = inside.pids(env)
        inside.asks_patiently(env)
        env.step_async([0, 1])
        assert eventually(lambda: f"about to {fault}" in output.read_text())
        assert eventually(lambda: psutil.Process(runner).status() in there)
        with pytest.raises(errors.WorkerTimeoutError, match=state) as caught:
            env.step_wait(timeout=0.5)
        assert caught.value.worker == (state,)


def test_a_task_that_does_not_run_is_not_confined() -> None:
    """Others of its repository may run, and may have run; the provenance still says how."""
    with make_env(sample("many_tasks"), policy={"prewarm": 0}) as suites:
        [first, second, *_] = [env for tasks in suites.values() for env in tasks.values()]
        assert (first.sandbox.report(), first.sandbox.usage()) == ([], {})
        first.reset()
        held = first.sandbox.usage()
        assert held["processes"] >= 1
        assert held["memory_bytes"] > 0
        assert {layer["layer"] for layer in first.sandbox.report()} >= {"seccomp", "rlimits"}
        assert second.sandbox.report() == []
        first.close()
        assert first.sandbox.report() == []
        assert suites.provenance["layers"]


@pytest.mark.usefixtures("neighbour")
@pytest.mark.parametrize("lane", ["auto", "frames"])
def test_a_jail_that_was_lost_confines_nobody(lane: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Until a reset has brought another; while it is merely late it is still the same one, and what
    it owes survives that somebody asks how it is."""
    monkeypatch.setattr(*inside.LATE_REPLY_GRACE, 120.0)
    policy = {"restart": "on_reset", "lane": lane}
    with started(sample("echo"), policy=policy, seed=None) as env:
        report, before = env.sandbox.report(), inside.loaded(env)
        assert report
        with halted(inside.pids(env)):
            env.step_async([[1.0, 0.0]])
            with pytest.raises(errors.WorkerTimeoutError):
                env.step_wait(timeout=0.05)
        assert env.sandbox.report() == report
        env.reset(options={"token": 2.0, "delay": 0.0})
        assert inside.loaded(env) is before
        with pytest.raises(errors.WorkerDiedError):
            env.step([[1.0, -1.0]])
        assert env.sandbox.report() == []
        env.reset()
        assert env.sandbox.report() == report
    assert env.sandbox.report() == []
