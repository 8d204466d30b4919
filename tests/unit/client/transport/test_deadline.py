"""Deadlines: asked for what is left, in any unit, for any length."""

from __future__ import annotations

import math

import pytest

from envhub_sandbox.transport import deadline as deadline_module
from envhub_sandbox.transport.deadline import Deadline, StepDeadline


@pytest.mark.parametrize("kind", [Deadline, StepDeadline])
def test_no_timeout_never_comes(kind: type[Deadline]) -> None:
    deadline = kind(None)
    assert (deadline.left_s(), deadline.left_ms(), deadline.passed) == (None, None, False)


def test_what_has_passed_has_nothing_left() -> None:
    """What is left is never negative; a wait is at least a millisecond, not for ever."""
    deadline = Deadline(-5.0)
    assert (deadline.left_s(), deadline.left_ms(), deadline.passed) == (0.0, 1, True)


@pytest.mark.parametrize("timeout_s", [1e6, 1e30, 1e308, math.inf])
def test_far_deadlines_can_be_waited_for(timeout_s: float) -> None:
    """Even infinity has milliseconds that poll() takes; who waits asks again afterwards."""
    deadline = Deadline(timeout_s)
    milliseconds = deadline.left_ms()
    assert milliseconds is not None
    assert 0 < milliseconds < 2**31
    assert not deadline.passed


def test_a_steps_deadline_counts_from_its_first_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each step has all of its time, and whoever never has to wait never reads the clock."""
    now = [100.0]
    monkeypatch.setattr(deadline_module, "monotonic", lambda: now[0])
    deadline = StepDeadline(5.0)
    for _ in range(2):
        deadline.running = False
        now[0] += 60.0
        assert not deadline.passed
        now[0] += 2.0
        assert deadline.left_s() == 3.0
        now[0] += 3.0
        assert deadline.passed
        assert deadline.left_ms() == 1
