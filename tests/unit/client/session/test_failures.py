"""The error of a failed request, why a state takes none, and how often a worker is replaced."""

from __future__ import annotations

from typing import Any
from unittest.mock import MagicMock

import pytest

from envhub_sandbox.errors import WorkerDiedError, WorkerError, WorkerTimeoutError
from envhub_sandbox.session.counters import Counters
from envhub_sandbox.session.failures import Failures, Restarts, backoff_s, refusal
from envhub_sandbox.settings.policy import Policy
from envhub_worker.protocol.lifecycle import State


def failures_of(lease: Any) -> Failures:
    lease.lifecycle.closed, lease.lifecycle.request = False, "step"
    return Failures(lease, MagicMock())


@pytest.mark.parametrize("kept", [True, False])
def test_a_server_is_asked_once_what_a_dead_jail_was_denied(kept: bool) -> None:
    """Before the jail is ended, and not again for the bundle: a silent one takes its time."""
    lease = MagicMock()
    lease.loaded.jail.kept = kept
    error = WorkerDiedError("it died")
    assert failures_of(lease).dead(error) is error
    asked = [call[0] for call in lease.mock_calls if call[0] in ("note_denied", "end")]
    assert asked == ["note_denied", *(["end"] if kept else [])]
    lease.repository.keep_crash.assert_called_once()
    late = MagicMock()  # of what came too late nothing was asked before
    failures_of(late).keep_crash(WorkerTimeoutError("late", request="reset", timeout_s=1.0))
    late.note_denied.assert_called_once()
    late.repository.keep_crash.assert_called_once()


@pytest.mark.parametrize(
    ("state", "kind", "said"),
    [
        (State.LATE, WorkerTimeoutError, "the reply to the last request is late; call reset"),
        (State.PENDING, WorkerTimeoutError, "the reply to the last request is late"),
        (State.DEAD, WorkerDiedError, "the worker process has died; make the environment again"),
        (State.EXPIRED, WorkerDiedError, "it was idle for too long"),
        (State.FOREIGN, WorkerError, "belongs to another process, and this is a fork of it"),
        (State.CLOSED, WorkerDiedError, "the environment was closed during step"),
    ],
)
def test_each_state_has_its_refusal(state: State, kind: type[Exception], said: str) -> None:
    error = refusal(state, "step", "never")
    assert type(error) is kind
    assert said in str(error)
    serving = {one for one in State if refusal(one, "step", "never") is None}
    assert serving == {State.IDLE, State.READY}, "no later state is taken for one that serves"
    assert "the last call was interrupted" in str(refusal(State.LATE, "step", "never", "call"))
    assert str(refusal(State.DEAD, "step", "on_reset")).endswith("has died; call reset() first")


def test_backoff_doubles_and_is_bounded() -> None:
    """The first restart is at once, those right after it wait longer and longer."""
    assert [backoff_s(0.1, n) for n in range(5)] == [0.0, 0.1, 0.2, 0.4, 0.8]
    assert backoff_s(0.1, 10_000) == 30.0
    assert backoff_s(0.0, 10_000) == 0.0


def test_restarts_are_counted_until_the_budget_ends() -> None:
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
