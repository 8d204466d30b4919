"""What confines an environment is its own jail's to say, for as long as it lives in one."""

import pytest

from envhub_sandbox import errors, make_env
from tests.support import inside
from tests.support.processes import halted
from tests.support.samples import sample
from tests.support.started import started


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
def test_a_jail_that_was_lost_confines_nobody(lane: str) -> None:
    """Until a reset has brought another; while it is merely late it is still the same one."""
    policy = {"restart": "on_reset", "lane": lane}
    with started(sample("echo"), policy=policy, seed=None) as env:
        report = env.sandbox.report()
        assert report
        with halted(inside.pids(env)):
            env.step_async([[1.0, 0.0]])
            with pytest.raises(errors.WorkerTimeoutError):
                env.step_wait(timeout=0.02)
        assert env.sandbox.report() == report
        env.reset()
        with pytest.raises(errors.WorkerDiedError):
            env.step([[1.0, -1.0]])
        assert env.sandbox.report() == []
        env.reset()
        assert env.sandbox.report() == report
    assert env.sandbox.report() == []
