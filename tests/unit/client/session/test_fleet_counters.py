"""What is counted once for all workers, what is their sum, and who is waited for."""

from __future__ import annotations

import pytest

from envhub_sandbox.session.counters import Counters, FleetCounters
from tests.support.in_process.fake_lane import FakeLane, session_over


class Wired(FakeLane):
    """A lane with traffic."""

    def traffic(self) -> tuple[int, int, int]:
        """Stale replies, bytes sent and bytes received."""
        return 1, 20, 300


@pytest.fixture
def parts() -> list[Counters]:
    return []


@pytest.fixture
def counters(parts: list[Counters]) -> FleetCounters:
    """Of an environment over three workers."""
    sessions = [session_over(Wired(1), (0, 1)) for _ in range(3)]
    parts += [session.counters for session in sessions]
    for session in sessions:
        session.counters.connected(session.lease.lane)
    return FleetCounters(parts)


def test_a_step_of_all_is_one_step(counters: FleetCounters, parts: list[Counters]) -> None:
    """Its time is that of the slowest; deaths, restarts and bytes are added up."""
    counters.requests += 1
    counters.stepped(4_000_000_000)
    for number, part in enumerate(parts):
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


def test_a_straggler_is_who_was_waited_for(counters: FleetCounters, parts: list[Counters]) -> None:
    for elapsed_ns in (2_000_000_000, 5_000_000_000, 1_000_000_000):
        counters.waited(1, elapsed_ns)
    parts[1].timeouts += 2
    straggler = counters.of_worker(1)
    assert straggler["waited_s"] == {"total": 8.0, "max": 5.0}
    assert (straggler["timeouts"], straggler["sent_bytes"]) == (2, 20)
    assert "requests" not in straggler, "a worker's requests are those of the whole"
    assert counters.of_worker(0)["waited_s"] == {"total": 0.0, "max": 0.0}
