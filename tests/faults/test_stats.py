"""The counters say what has happened."""

from __future__ import annotations

import pytest

from envhub_sandbox import errors
from envhub_sandbox.session.counters import KEPT, Counters
from tests.support import inside
from tests.support.processes import halted
from tests.support.samples import sample
from tests.support.started import started


@pytest.mark.usefixtures("neighbour")
@pytest.mark.parametrize("lane", ["auto", "frames"])
def test_counters_follow_what_happens(lane: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps, timeouts, deaths and restarts are counted once each, over both lanes."""
    monkeypatch.setattr(*inside.LATE_REPLY_GRACE, 120.0)
    policy = {"restart": "on_reset"}
    with started(sample("echo"), lane=lane, policy=policy, seed=None) as env:
        for _ in range(5):
            env.step([[1.0, 0.0]])
        with halted(inside.pids(env)):
            env.step_async([[1.0, 0.0]])
            with pytest.raises(errors.WorkerTimeoutError):
                env.step_wait(timeout=0.02)
        assert env.sandbox.stats()["state"] == "LATE"
        env.reset()
        with pytest.raises(errors.WorkerDiedError):
            env.step([[1.0, -1.0]])
        assert env.sandbox.stats()["state"] == "DEAD"
        env.reset()
        found = env.sandbox.stats()
        latency = found.pop("step_latency_s")
        assert found.pop("sent_bytes") > 6 * 8
        assert found.pop("received_bytes") > 6 * (8 + 8 + 1 + 1)
        assert found == {
            "requests": 3 + 5 + 1 + 1,
            "steps": 5,
            "timeouts": 1,
            "deaths": 1,
            "restarts": 1,
            "stale_replies": 0,
            "state": "READY",
        }
        assert latency["total"] >= latency["max"]
        assert 0 < latency["p50"] <= latency["p90"] <= latency["p99"] <= latency["max"]
    assert env.sandbox.stats()["state"] == "CLOSED"


def test_latencies_are_those_of_the_last_steps() -> None:
    counters = Counters()
    assert counters.snapshot()["step_latency_s"] == {"total": 0.0}
    for _ in range(KEPT):
        counters.stepped(10**9)
    for _ in range(KEPT):
        counters.stepped(2 * 10**9)
    expected = {"p50": 2.0, "p90": 2.0, "p99": 2.0, "max": 2.0, "total": 3.0 * KEPT}
    assert counters.snapshot()["step_latency_s"] == expected
    assert counters.snapshot()["steps"] == 2 * KEPT
