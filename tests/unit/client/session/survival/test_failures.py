"""The error of a request that failed."""

from __future__ import annotations

from typing import Any
from unittest.mock import MagicMock

import pytest

from envhub_sandbox.errors import WorkerDiedError, WorkerTimeoutError
from envhub_sandbox.session.survival.failures import Failures


def failures_of(lease: Any) -> Failures:
    """Of an environment with this jail."""
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


def test_a_bundle_of_what_came_too_late_has_it_too() -> None:
    """It was not asked before."""
    lease = MagicMock()
    failures_of(lease).keep_crash(WorkerTimeoutError("late", request="reset", timeout_s=1.0))
    lease.note_denied.assert_called_once()
    lease.repository.keep_crash.assert_called_once()
