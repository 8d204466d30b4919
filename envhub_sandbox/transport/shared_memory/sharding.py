"""How many processes share an environment's work, and how much of it each gets.

One core is the client's. The shards that get cores of their own wait for work awake; the others
sleep, and run on cores that somebody else needs too, so each of their steps costs two wake-ups
more. Where a sub-environment's step is short, that is worth several of them: such shards get
fewer. One that would save less of each step than it is worth, with its memory and its start, is
not started at all. How long a step takes is what the last use of the same pin took, so the first
one is shared out evenly. Results never depend on any of this.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from envhub_sandbox.system.files import write_whole
from envhub_sandbox.transport.pace import Cost, Pace
from envhub_sandbox.transport.shared_memory.affinity import CPUS
from envhub_worker.protocol.manifest.manifest import EnvManifest
from envhub_worker.protocol.spaces.batches import even_bounds

ASK_NS = 10_000.0
"""What it costs to ask a shard that waits awake, before it has been measured."""
_WAKE_UP_NS = 15_000.0
"""How much more it costs to ask one that sleeps, before that has been measured."""
_WORTH_NS = 15_000.0
"""How much shorter each step must be for shards that sleep to be started: they take memory, and a
start that a short life does not make up for."""
_FORGETTING = 0.7
"""Per use without a sleeping shard: a busy machine must not be remembered for ever."""
_WORST_NS = 1e12
_RISE = 2.0
"""Per use of which one step was measured, at most: another process may have run in its midst."""
_NOTICED_NS = 2_000
"""A wait that is shorter is none: the answer was there already."""


@dataclass(frozen=True)
class Sample:
    """One step over several shards, in nanoseconds.

    Attributes:
        slept: From the client's call until all shards that sleep were known to have answered.
        elapsed: Until all were.
        asleep, awake: What the longest shard of each kind took itself.
    """

    slept: int
    elapsed: int
    asleep: int
    awake: int


def pace_of(samples: Sequence[Sample], asleep: int, awake: int) -> Pace:
    """What typical steps took shards of these sizes: the largest of each kind."""
    sleeping = median(one.slept - one.asleep for one in samples)
    # only where it was waited for after the others can be told when an awake one's end was known
    waited = [one.elapsed - one.awake for one in samples if one.elapsed - one.slept > _NOTICED_NS]
    waking = median(waited) if 2 * len(waited) > len(samples) else sleeping - _WAKE_UP_NS
    return Pace(
        Cost(max(1.0, waking), median(one.awake for one in samples) / awake),
        Cost(max(1.0, sleeping), median(one.asleep for one in samples) / asleep),
    )


def awake_shards(shards: int) -> int:
    """How many of some shards, the first ones, get a core that is not the client's."""
    return min(shards, len(CPUS) - 1)


def bounds_for(
    env: EnvManifest, num_workers: int | None, pace: Pace | None
) -> list[tuple[int, int]]:
    """The slices of the sub-environments, one for each shard.

    Args:
        env: What the environment is.
        num_workers: As many shards, if they can be had; None for as many as are useful.
        pace: What it took the last time.
    """
    if not env.shardable or (num_workers is None and env.sync):
        return even_bounds(env.num_envs, 1)
    wanted = len(os.sched_getaffinity(0)) if num_workers is None else num_workers
    shards = max(1, min(wanted, env.num_envs))
    awake = awake_shards(shards)
    if pace is None or awake in (0, shards):
        return even_bounds(env.num_envs, shards)
    return _weighted(env.num_envs, shards, awake, pace, may_drop=num_workers is None)


def _weighted(
    count: int, shards: int, awake: int, pace: Pace, *, may_drop: bool
) -> list[tuple[int, int]]:
    """All shards done at the same time: those that sleep have ``fewer`` sub-environments."""
    quick = pace.awake
    slow = pace.asleep or Cost(quick.fixed_ns + _WAKE_UP_NS, quick.step_ns)
    sleepers = shards - awake
    head_start = awake * (slow.fixed_ns - quick.fixed_ns)
    each = awake * slow.step_ns + sleepers * quick.step_ns
    small = round((count * quick.step_ns - head_start) / each)
    saved_ns = small * sleepers * quick.step_ns / awake
    if may_drop and (small < 1 or saved_ns < _WORTH_NS):
        return even_bounds(count, awake)
    small = min(max(1, small), (count - awake) // sleepers)
    large = count - sleepers * small
    bounds = even_bounds(large, awake)
    starts = range(large, count, small)
    return [*bounds, *((start, start + small) for start in starts)]


class PaceBook:
    """What the environments of one manifest took, in a file beside it.

    Args:
        path: The file, or None for what must not be remembered.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path

    def of(self, env: EnvManifest) -> Pace | None:
        """What an environment took the last time; None where nobody knows."""
        entry = self._read().get(_name(env))
        if not (isinstance(entry, list) and len(entry) == 4 and all(map(_is_sane, entry))):
            return None
        awake_fixed, awake_step, asleep_fixed, asleep_step = map(float, entry)
        return Pace(Cost(awake_fixed, awake_step), Cost(asleep_fixed, asleep_step))

    def note(self, env: EnvManifest, pace: Pace) -> None:
        """Remember it. A cache that cannot be written is no error."""
        if self._path is None:
            return
        known = self.of(env)
        awake, asleep = pace.awake, pace.asleep
        if asleep is None:  # one step was measured, and no wake-up
            step_ns = min(awake.step_ns, _RISE * known.awake.step_ns) if known else awake.step_ns
            awake = Cost(awake.fixed_ns, step_ns)
            asleep = _forgotten(known, awake)
        entry = [awake.fixed_ns, awake.step_ns, asleep.fixed_ns, asleep.step_ns]
        if all(map(_is_sane, entry)):
            self._write({**self._read(), _name(env): entry})

    def _read(self) -> dict[str, object]:
        try:
            found = json.loads(self._path.read_bytes()) if self._path else {}
        except (OSError, ValueError):
            return {}
        return found if isinstance(found, dict) else {}

    def _write(self, entries: dict[str, object]) -> None:
        assert self._path is not None
        with contextlib.suppress(OSError):
            write_whole(self._path, json.dumps(entries).encode())


def _forgotten(known: Pace | None, awake: Cost) -> Cost:
    """What a sleeping shard takes, as far as is known from earlier uses."""
    least = awake.fixed_ns + _WAKE_UP_NS
    if known is None or known.asleep is None:
        return Cost(least, awake.step_ns)
    return Cost(max(least, known.asleep.fixed_ns * _FORGETTING), awake.step_ns)


def _name(env: EnvManifest) -> str:
    return json.dumps([env.suite, str(env.task)])


def _is_sane(value: object) -> bool:
    # bool is an int; nan compares false
    return type(value) in (int, float) and 1 <= value < _WORST_NS  # type: ignore[operator]
