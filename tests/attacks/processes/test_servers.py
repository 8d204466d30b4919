"""Attacking our own processes that a jail hangs from: worker server, zygote and init."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.settings import policy
from envhub_worker import bootstrap
from tests.attacks.harness import Arena, Run, call, control_run, run_in
from tests.support.processes import eventually

pytestmark = pytest.mark.short
FAMILY = "Our own processes"


def test_what_watches_a_jail_cannot_be_stopped_by_it(arena: Arena) -> None:
    """SIGSTOP reaches none of the processes above a jail, by any pid that it may try."""
    with arena.environment() as env:
        env.reset()
        run = run_in(env, "environment")
        above = watchers(run)
        try:
            with control_run("stop_processes", {"pids": above, "own": False}) as control:
                assert eventually(lambda: stopped(above) == above), control.text
            resume(above)
            call(env, run, "stop_processes", {"pids": above, "own": True})
            through = eventually(lambda: bool(stopped(above)), 0.5)
        finally:
            resume(above)
    arena.judge("stop server, zygote and init", "succeeds", through, run.text)


def test_a_client_runs_nothing_in_a_zygote_by_the_variables_that_it_is_started_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that does not check itself; a zygote is not confined when it starts."""
    mark = tmp_path / "mark"
    (tmp_path / "sitecustomize.py").write_text(f"open({str(mark)!r}, 'w')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    command = bootstrap.command(sys.executable, "zygote", "no descriptor")
    subprocess.run(command, env={"PYTHONPATH": str(tmp_path)}, stderr=subprocess.DEVNULL)
    assert mark.exists()
    mark.unlink()
    monkeypatch.setattr(policy, "why_not", lambda name, value: "")
    with pytest.raises(EnvHubError, match="confinement"):
        make_env("examples:cartpole", policy={"environment": ("PYTHONPATH",)})
    assert not mark.exists()


def watchers(run: Run) -> list[int]:
    [runner] = run.pids()
    found: list[int] = []
    for process in psutil.Process(runner).parents():
        if process.pid == os.getpid():
            return found
        found.append(process.pid)
    raise AssertionError("the jail does not hang from this process")


def stopped(pids: list[int]) -> list[int]:
    bad = (psutil.STATUS_STOPPED, psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
    return [pid for pid in pids if psutil.Process(pid).status() in bad]


def resume(pids: list[int]) -> None:
    for pid in pids:
        os.kill(pid, signal.SIGCONT)
