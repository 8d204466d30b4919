"""What is made of measured steps, once an environment is closed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from envhub_sandbox.transport.pace import Cost, Pace
from envhub_sandbox.transport.shared_memory.pacing import Pacing
from envhub_sandbox.transport.shared_memory.sharding import ASK_NS


@dataclass
class Shard:
    """As far as it is looked at: what its last measured step took it, after so many requests."""

    busy_ns: int
    sequence: int


def shards(sequence: int, *busy_ns: int) -> list[Any]:
    """One for each."""
    return [Shard(busy, sequence) for busy in busy_ns]


def told(pacing: Pacing, *measured: int) -> float:
    """How long a step is, where nothing is told of wake-ups."""
    pace = pacing.pace(shards(*measured))
    assert pace is not None
    assert pace == Pace(Cost(ASK_NS, pace.awake.step_ns), None)
    return pace.awake.step_ns


def test_a_life_without_samples_tells_how_long_a_step_is() -> None:
    """One was measured, in each shard; what was disturbed is longer."""
    pacing = Pacing([2, 2], awake=1)
    assert told(pacing, 256, 14_000, 90_000) == told(pacing, 5_000, 90_000, 14_000) == 7_000
    assert told(Pacing([4], awake=1), 256, 28_000) == 7_000


def test_in_a_short_life_steps_count_as_shorter() -> None:
    """It does not make up for the start of a process more; but a long step stays a long one."""
    pacing = Pacing([4], awake=1)
    assert told(pacing, 128, 28_000) == 3_500
    assert told(pacing, 61, 28_000) == told(pacing, 33, 28_000) == 1_750


def test_a_life_without_a_measured_step_tells_nothing() -> None:
    """Nor does one of which a shard has measured none."""
    pacing = Pacing([2, 2], awake=1)
    assert pacing.pace(shards(31, 0, 0)) is None
    assert pacing.pace(shards(61, 14_000, 0)) is None


def test_wake_ups_are_told_by_a_long_life_only() -> None:
    """One or two samples say little of what depends on whoever runs beside."""
    pacing = Pacing([2, 2], awake=1)
    pacing.sample(shards(64, 14_000, 20_000), slept_ns=60_000, elapsed_ns=61_000)
    early = pacing.pace(shards(64, 14_000, 20_000))
    late = pacing.pace(shards(256, 14_000, 20_000))
    assert early is not None
    assert early.asleep is None
    assert late is not None
    assert late.asleep == Cost(40_000, 10_000)
