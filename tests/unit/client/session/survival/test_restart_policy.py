"""How often, and how soon, a worker that died is replaced."""

from __future__ import annotations

import pytest

from envhub_sandbox.errors import WorkerDiedError
from envhub_sandbox.session.counters import Counters
from envhub_sandbox.session.survival.restart_policy import Restarts, backoff_s
from envhub_sandbox.settings.policy import Policy


def test_backoff_doubles_and_is_bounded() -> None:
    """The first restart is at once, those right after it wait longer and longer."""
    assert [backoff_s(0.1, n) for n in range(5)] == [0.0, 0.1, 0.2, 0.4, 0.8]
    assert backoff_s(0.1, 10_000) == 30.0
    assert backoff_s(0.0, 10_000) == 0.0


def test_restarts_are_counted_until_the_budget_ends() -> None:
    """And no more are made once the environment is closed."""
    counters = Counters()
    restarts = Restarts(Policy(restart="on_reset", restart_budget=1), counters)
    restarts.spend("reset")
    with pytest.raises(WorkerDiedError, match="all 1 restarts are used up"):
        restarts.spend("reset")
    assert counters.restarts == counters.numbers()["restarts"] == 1
    closed = Restarts(Policy(restart="on_reset"), Counters())
    closed.give_up()
    with pytest.raises(WorkerDiedError, match="closed during reset"):
        closed.spend("reset")
