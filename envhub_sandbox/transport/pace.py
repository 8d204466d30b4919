"""How long the steps of an environment take: measured now and then, remembered for the next use."""

from __future__ import annotations

import contextlib
import json
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

from envhub_sandbox.system.files import write_whole_file
from envhub_worker.protocol.manifest.manifest import EnvManifest

ASK_NS = 10_000.0
"""What it costs to ask a shard that waits awake, before it has been measured."""
WAKE_UP_NS = 15_000.0
"""How much more it costs to ask one that sleeps, before that has been measured."""
_STEPS = 256
"""Steps after which what shards cost one another is worth remembering."""
_LEAST_SHARE = 0.25
"""How much a step counts at least where a life was shorter."""
_SAMPLES = 64
_NOTICED_NS = 2_000
"""A wait that is shorter is none: the answer was there already."""
_FORGETTING = 0.7
"""Per use without a sleeping shard: a busy machine must not be remembered for ever."""
_RISE = 2.0
"""Per use of which one step was measured, at most: another process may have run in its midst."""
_WORST_NS = 1e12


class Cost(NamedTuple):
    """What a step of a shard took, from the client's call on.

    Attributes:
        fixed_ns: Until it has begun, and until its end is known.
        step_ns: For each of its sub-environments.
    """

    fixed_ns: float
    step_ns: float


class Pace(NamedTuple):
    """What an environment took.

    Attributes:
        awake: A shard that waits awake, on a core of its own.
        asleep: One that sleeps, and runs on a core that another process needs too; None without
            one.
    """

    awake: Cost
    asleep: Cost | None


class Sample(NamedTuple):
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


class PaceMeter:
    """Samples of steps over several shards.

    Args:
        sizes: Sub-environments of each shard.
        awake: How many shards, the first ones, may wait awake.
    """

    def __init__(self, sizes: Sequence[int], awake: int) -> None:
        self._sizes = list(sizes)
        self._awake = awake
        self._samples: deque[Sample] = deque(maxlen=_SAMPLES)

    def sample(self, busy_ns: Sequence[int], slept_ns: int, elapsed_ns: int) -> None:
        """Take note of the last step, and of what it took each shard that has measured it."""
        awake, asleep = busy_ns[: self._awake], busy_ns[self._awake :]
        if asleep and awake and all(busy_ns):
            self._samples.append(Sample(slept_ns, elapsed_ns, max(asleep), max(awake)))

    def pace(self, steps: int, busy_ns: Sequence[int]) -> Pace | None:
        """What the steps took; None where none was measured.

        An evaluation plays each task of a suite for a few steps. After so few, one or two of them
        do not say what a wake-up costs, but how long a step is: the shard that was disturbed least
        says so. It counts as shorter than it was: so short a life does not make up for the start
        of a process more, and one step may have been disturbed in every shard.

        Args:
            steps: How many there were.
            busy_ns: What the last measured one took each shard.
        """
        if self._samples and steps >= _STEPS:
            awake, asleep = self._sizes[: self._awake], self._sizes[self._awake :]
            return pace_of(self._samples, max(asleep), max(awake))
        each = [busy / size for busy, size in zip(busy_ns, self._sizes, strict=True)]
        share = min(1.0, max(_LEAST_SHARE, steps / _STEPS))
        return Pace(Cost(ASK_NS, share * min(each)), None) if all(each) else None


def pace_of(samples: Sequence[Sample], asleep: int, awake: int) -> Pace:
    """What typical steps took shards of these sizes: the largest of each kind."""
    sleeping = median(one.slept - one.asleep for one in samples)
    # the end of an awake one is known exactly only where it was waited for after the others
    waited = [one.elapsed - one.awake for one in samples if one.elapsed - one.slept > _NOTICED_NS]
    waking = median(waited) if 2 * len(waited) > len(samples) else sleeping - WAKE_UP_NS
    return Pace(
        Cost(max(1.0, waking), median(one.awake for one in samples) / awake),
        Cost(max(1.0, sleeping), median(one.asleep for one in samples) / asleep),
    )


class PaceBook:
    """What the environments of one manifest took, in a file beside it.

    Args:
        path: The file, or None for what must not be remembered.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path

    def of(self, env: EnvManifest) -> Pace | None:
        """What an environment took the last time; None where that is not known."""
        entry = self._read().get(_name(env))
        if not (isinstance(entry, list) and len(entry) == 4 and all(map(_is_sane, entry))):
            return None
        return Pace(Cost(*map(float, entry[:2])), Cost(*map(float, entry[2:])))

    def note(self, env: EnvManifest, pace: Pace) -> None:
        """Remember it. A cache that cannot be written is no error."""
        if self._path is None:
            return
        awake, asleep = pace
        if asleep is None:  # one step was measured, and no wake-up
            known = self.of(env)
            if known is not None:
                awake = Cost(awake.fixed_ns, min(awake.step_ns, _RISE * known.awake.step_ns))
            fixed_ns = awake.fixed_ns + WAKE_UP_NS
            if known is not None and known.asleep is not None:
                fixed_ns = max(fixed_ns, known.asleep.fixed_ns * _FORGETTING)
            asleep = Cost(fixed_ns, awake.step_ns)
        entry = [*awake, *asleep]
        if all(map(_is_sane, entry)):
            with contextlib.suppress(OSError):
                write_whole_file(
                    self._path, json.dumps({**self._read(), _name(env): entry}).encode()
                )

    def _read(self) -> dict[str, object]:
        try:
            found = json.loads(self._path.read_bytes()) if self._path else {}
        except (OSError, ValueError):
            return {}
        return found if isinstance(found, dict) else {}


def _name(env: EnvManifest) -> str:
    return json.dumps([env.suite, str(env.task)])


def _is_sane(value: object) -> bool:
    # bool is an int; nan compares false
    return type(value) in (int, float) and 1 <= value < _WORST_NS  # type: ignore[operator]
