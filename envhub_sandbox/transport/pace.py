"""How long an environment's steps take: what a lane measures, and shards are chosen by."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Cost:
    """What a step of a shard took, from the client's call on.

    Attributes:
        fixed_ns: Until it has begun, and until its end is known.
        step_ns: For each of its sub-environments.
    """

    fixed_ns: float
    step_ns: float


@dataclass(frozen=True)
class Pace:
    """What an environment took.

    Attributes:
        awake: A shard that waits awake, on a core of its own.
        asleep: One that sleeps, and runs on a core that somebody else needs too; None without one.
    """

    awake: Cost
    asleep: Cost | None
