"""Calls side by side: all are waited for, and each keeps what it returned or raised."""

from __future__ import annotations

import threading

import pytest

from envhub_sandbox.system.threads import Calls

DEADLINE_S = 60.0


def test_calls_run_at_the_same_time() -> None:
    """Each waits for the others, so that one after the other would never end."""
    barrier = threading.Barrier(8)
    calls = Calls([lambda: barrier.wait(DEADLINE_S)] * 8)
    assert calls.wait(DEADLINE_S)
    assert sorted(one.result() for one in calls.each) == list(range(8))


def test_each_keeps_its_own_failure() -> None:
    """It is raised when its result is asked for, and ends no other."""

    def fails() -> int:
        raise ValueError("this one")

    calls = Calls([lambda: 1, fails, lambda: 3])
    assert calls.wait(DEADLINE_S)
    assert [one.value for one in calls.each] == [1, None, 3]
    with pytest.raises(ValueError, match="this one"):
        calls.each[1].result()


def test_a_wait_may_end_before_the_calls() -> None:
    go_on = threading.Event()
    calls = Calls([lambda: go_on.wait(DEADLINE_S)])
    assert not calls.wait(0.05)
    assert not calls.each[0].done
    go_on.set()
    assert calls.wait(DEADLINE_S)
    assert Calls([]).wait(), "nothing to do is done, without any thread"
