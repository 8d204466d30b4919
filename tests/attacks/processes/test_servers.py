"""Attacking our own processes that a jail hangs from: worker server, zygote and init."""

from __future__ import annotations

import os
import signal

import psutil
import pytest

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


def watchers(run: Run) -> list[int]:
    """The pids between this process and the one that runs the payload."""
    [runner] = run.pids()
    found: list[int] = []
    for process in psutil.Process(runner).parents():
        if process.pid == os.getpid():
            return found
        found.append(process.pid)
    raise AssertionError("the jail does not hang from this process")


def stopped(pids: list[int]) -> list[int]:
    """Those of the processes that have been stopped or ended."""
    bad = (psutil.STATUS_STOPPED, psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
    return [pid for pid in pids if psutil.Process(pid).status() in bad]


def resume(pids: list[int]) -> None:
    for pid in pids:
        os.kill(pid, signal.SIGCONT)
