"""Waiting for a server that has no room: as long as that is worth it, and no longer."""

from __future__ import annotations

from typing import Any

import pytest

from envhub_sandbox.errors import EnvHubError, ServerBusyError, WorkerDiedError
from envhub_sandbox.session.jails import launcher as module
from envhub_sandbox.session.jails.launcher import retry_while_busy
from envhub_sandbox.transport.deadline import StartupDeadline
from envhub_worker.protocol.messages.busy import DRAINING

_FULL = ServerBusyError("full", quota="jails", used=1, limit=1, retry_s=0.1)
_ENDING = ServerBusyError("it ends", quota=DRAINING, used=0, limit=0, retry_s=0.1)
_GONE = WorkerDiedError("no answer", reason="connection")


@pytest.fixture(autouse=True)
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    time = [0.0]
    monkeypatch.setattr(module, "monotonic", lambda: time[0])
    monkeypatch.setattr(module, "sleep", lambda for_s: time.__setitem__(0, time[0] + for_s))
    return time


def asked(*answers: EnvHubError, retry_s: float = 60.0, **deadline: Any) -> int:
    """How often it was asked until there was room."""
    left = list(answers)
    count = 0

    def ask() -> int:
        nonlocal count
        count += 1
        if left:
            raise left.pop(0)
        return count

    return retry_while_busy(ask, retry_s, StartupDeadline(None, **deadline), "org/repo")


@pytest.mark.parametrize("answers", [(), (_FULL,), (_FULL, _FULL), (_ENDING, _GONE, _GONE)])
def test_it_is_asked_until_there_is_room(answers: tuple[EnvHubError, ...]) -> None:
    """Also where the server ends, and another is about to stand in its place."""
    assert asked(*answers) == len(answers) + 1


def test_the_line_ends_with_its_time(now: list[float]) -> None:
    """The refusal is the answer then; what is started in advance gives way at once."""
    with pytest.raises(ServerBusyError):
        asked(*[_FULL] * 1000, retry_s=5.0)
    assert 5.0 <= now[0] < 6.0
    for given in ({"retry_s": 0.0}, {"unasked": True}):
        with pytest.raises(ServerBusyError):
            asked(_FULL, **given)


@pytest.mark.parametrize("error", [_GONE, WorkerDiedError("killed", reason="signal")])
def test_a_death_is_no_reason_to_wait(error: EnvHubError) -> None:
    with pytest.raises(WorkerDiedError):
        asked(error)
