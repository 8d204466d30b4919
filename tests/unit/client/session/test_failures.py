"""The error of a failed request, why a state takes none, and how often a worker is replaced."""

import sys
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest

from envhub_sandbox.errors import WorkerDiedError, WorkerError, WorkerTimeoutError
from envhub_sandbox.extras.several_workers.fleet_counters import FleetCounters
from envhub_sandbox.session.counters import Counters
from envhub_sandbox.session.failures import Failures, backoff_s, refusal
from envhub_sandbox.session.recorder import Recorder, recorder_for
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import State
from tests.support.in_process.fake_lane import FakeLane, session_over


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
    assert [backoff_s(0.1, n) for n in range(5)] == [0.0, 0.1, 0.2, 0.4, 0.8]
    assert backoff_s(0.1, 10_000) == 30.0
    assert backoff_s(0.0, 10_000) == 0.0


# --- What is counted once for all workers, what is their sum, and who is waited for


def test_a_step_of_all_is_one_step() -> None:
    """Its time is that of the slowest; deaths, restarts and bytes are added up. A straggler is the
    worker that was waited for most."""
    parts = [Counters() for _ in range(3)]
    counters = FleetCounters(parts)
    counters.requests += 1
    counters.stepped(4_000_000_000)
    for number, part in enumerate(parts):
        part.connected(MagicMock(traffic=lambda: (1, 20, 300)))
        part.requests += 1
        part.stepped(1_000_000_000)
        part.deaths += number
        part.restarts += 1
    whole = counters.numbers()
    assert (whole["requests"], whole["steps"], whole["step_seconds"]) == (1, 1, 4.0)
    assert (whole["deaths"], whole["restarts"], whole["timeouts"]) == (3, 3, 0)
    names = ("stale_replies", "sent_bytes", "received_bytes")
    assert [whole[name] for name in names] == [3, 60, 900]
    assert counters.snapshot()["step_latency_s"]["max"] == 4.0
    for elapsed_ns in (2_000_000_000, 5_000_000_000, 1_000_000_000):
        counters.waited(1, elapsed_ns)
    straggler = counters.of_worker(1)
    assert straggler["waited_s"] == {"total": 8.0, "max": 5.0}
    assert (straggler["steps"], straggler["sent_bytes"]) == (1, 20)
    assert "requests" not in straggler, "a worker's requests are those of the whole"
    assert counters.of_worker(0)["waited_s"] == {"total": 0.0, "max": 0.0}


def test_without_the_extra_nothing_is_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    """An installation may lack it: requests and deaths are as ever, and no bundle is named."""
    assert type(recorder_for(8)) is not Recorder  # the control
    for missing in ("envhub_sandbox.extras.crash", "envhub_sandbox.extras.crash.history"):
        monkeypatch.setitem(sys.modules, missing, None)
    lane = FakeLane()
    session = session_over(lane)
    assert type(session.recorder) is Recorder
    assert session.requests.ask("render", lambda number, _: m.Render(number)) == [lane.answer]
    assert session.recorder.of_part().write(Path("nowhere"), MagicMock()) is None
