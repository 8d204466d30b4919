"""One use of an environment at a time, and what is done where a close or a lie came meanwhile."""

from __future__ import annotations

import contextlib
from typing import Any
from unittest.mock import MagicMock

import pytest

from envhub_sandbox.errors import ActionError, RemoteProtocolError, WorkerDiedError
from envhub_sandbox.session.use_lock import UseLock
from envhub_worker.protocol.lifecycle import State


@pytest.fixture
def lease() -> Any:
    made = MagicMock()
    made.repository.named = contextlib.nullcontext
    made.lifecycle.state, made.lifecycle.closed = State.READY, False
    return made


def closed(lease: Any, fails: BaseException) -> BaseException:
    """What a request meets while another thread closes, which does not wait."""
    lease.lifecycle.state, lease.lifecycle.closed = State.CLOSED, True
    return fails


@pytest.mark.parametrize(
    ("fails", "told"),
    [
        (OSError("the socket is gone"), WorkerDiedError),
        (WorkerDiedError("closed"), WorkerDiedError),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ],
)
def test_a_close_in_its_midst_is_finished_and_told(
    lease: Any, fails: BaseException, told: type[BaseException]
) -> None:
    """What is left is given back once, and a Ctrl-C stays one; so without an error."""
    with pytest.raises(told) as caught, UseLock(lease, MagicMock()).hold("step"):
        raise closed(lease, fails)
    assert isinstance(caught.value, type(fails)) or caught.value.__cause__ is fails
    with UseLock(lease, MagicMock()).hold("step"):
        pass
    assert lease.let_go.call_count == 2


@pytest.mark.parametrize(
    ("fails", "state", "told", "ends"),
    [
        (TypeError("unhashable"), State.READY, RemoteProtocolError, True),
        (RemoteProtocolError("a lie"), State.READY, RemoteProtocolError, True),
        (ActionError("the caller's"), State.READY, ActionError, False),
        (TypeError("dealt with"), State.LATE, TypeError, False),
    ],
)
def test_a_worker_whose_replies_break_a_rule_is_given_up(
    lease: Any, fails: Exception, state: State, told: type[Exception], ends: bool
) -> None:
    """Whatever the handling of them raised; errors of the caller's, and old ones, end nothing."""
    failures = MagicMock()
    lease.lifecycle.state = state
    with pytest.raises(told), UseLock(lease, failures).judging("step"):
        raise fails
    assert failures.dead.called == ends
