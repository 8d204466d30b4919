"""Whether a call is about a process of the jail's own: here, this process's children."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from envhub_worker.lockdown.seccomp.targets import is_another_target, never_a_target

_NOBODY = 1 << 30
"""Numbers end long before."""


@pytest.fixture(scope="module")
def children() -> Iterator[tuple[int, int]]:
    """Two processes, of which neither is below the other."""
    both = [subprocess.Popen(["sleep", "600"]) for _ in range(2)]
    yield both[0].pid, both[1].pid
    for one in both:
        one.kill()
        one.wait()


@pytest.mark.parametrize(
    ("call", "place"),
    [
        *((name, 0) for name in ("kill", "tkill", "tgkill", "rt_sigqueueinfo", "pidfd_open")),
        *(("sched_setscheduler", 0), ("sched_setaffinity", 0)),
        *(("setpriority", 1), ("ioprio_set", 1)),
    ],
)
def test_what_is_not_below_init_is_another(
    call: str, place: int, children: tuple[int, int]
) -> None:
    """Also what cannot have been there; not so the caller, nor what lives with it."""
    first, second = children

    def about(number: int, *, init: int) -> bool:
        before = (1,) if call == "ioprio_set" else (0,) * place
        words = (*before, number, signal.SIGTERM, signal.SIGTERM)
        return is_another_target(call, words[:3], first, init)

    assert not about(first, init=os.getpid())
    assert not about(second, init=os.getpid())
    assert not about(0, init=os.getpid())
    assert about(second, init=first)
    assert about(_NOBODY, init=os.getpid())
    assert about(os.getpid(), init=os.getpid()) == (call != "pidfd_open")


def test_who_only_looks_signals_nobody(children: tuple[int, int]) -> None:
    """Groups and everybody are named by numbers below zero; a group of one's own may have ended."""
    first, second = children
    assert not is_another_target("kill", (second, 0, 0), first, first)
    assert is_another_target("kill", (-1, 15, 0), first, os.getpid())
    assert is_another_target("kill", (-_NOBODY, 15, 0), first, os.getpid())
    assert not is_another_target("kill", (-second, 15, 0), first, os.getpid())
    assert not is_another_target("setpriority", (1, _NOBODY, 0), first, os.getpid())


def test_who_has_ended_may_have_been_its_own() -> None:
    ended = subprocess.Popen(["true"])
    ended.wait()
    assert not is_another_target("kill", (ended.pid, 15, 0), os.getpid(), os.getpid())
    assert not never_a_target(f"/proc/{ended.pid}/stat")


def test_a_path_names_a_process_that_nobody_can_have_met() -> None:
    assert never_a_target(f"/proc/{_NOBODY}/cmdline")
    assert never_a_target(f"/proc/{_NOBODY}")
    for path in (f"/proc/{os.getpid()}/cmdline", "/proc/self/cmdline", f"/home/{_NOBODY}"):
        assert not never_a_target(path)
    assert not never_a_target(f"/proc/{'9' * 5000}/cmdline")


def test_a_namespace_of_ones_own_has_come_to_fewer_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its first process knows the last one; elsewhere they may have begun again since."""
    most = int(Path("/proc/sys/kernel/pid_max").read_text())
    assert not never_a_target(f"/proc/{most - 1}/cmdline")
    monkeypatch.setattr(os, "getpid", lambda: 1)
    assert never_a_target(f"/proc/{most}/cmdline")
    assert not never_a_target("/proc/1/cmdline")
