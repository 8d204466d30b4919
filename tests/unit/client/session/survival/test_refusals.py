"""Why an environment takes no request, in each state of its life."""

from __future__ import annotations

import pytest

from envhub_sandbox.errors import WorkerDiedError, WorkerError, WorkerTimeoutError
from envhub_sandbox.session.survival.refusals import refusal
from envhub_worker.protocol.lifecycle import State


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
    """By its class, with what to do."""
    error = refusal(state, "step", "never")
    assert type(error) is kind
    assert said in str(error)


def test_every_state_but_two_refuses() -> None:
    """No state that is added later is taken for one that serves."""
    serving = {state for state in State if refusal(state, "step", "never") is None}
    assert serving == {State.IDLE, State.READY}


def test_the_advice_follows_from_what_happened() -> None:
    """An interrupted wait is named, and a death is survived by a reset where the policy says so."""
    assert "the last call was interrupted" in str(refusal(State.LATE, "step", "never", "call"))
    assert str(refusal(State.DEAD, "step", "on_reset")).endswith("has died; call reset() first")
