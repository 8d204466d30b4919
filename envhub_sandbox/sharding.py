"""How many processes share an environment's work, and how much of it each gets.

One core is the client's. The shards that get cores of their own wait for work awake; the others
sleep, and run on cores that somebody else needs too, so each of their steps costs two wake-ups
more. Where a sub-environment's step is short, that is worth several of them: such shards get
fewer, or are not started at all. How long it takes is what the last use of the same pin took,
so the first one is shared out evenly. Results never depend on any of this.
"""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

from envhub_sandbox.cores import CPUS
from envhub_worker.protocol.batches import even_bounds
from envhub_worker.protocol.manifest import EnvManifest

_WAKE_UP_NS = 15_000.0
"""What a sleeping shard costs, before it has been measured."""
_FORGETTING = 0.7
"""Per use without a sleeping shard: a busy machine must not be remembered for ever."""
_WORST_NS = 1e12


@dataclass(frozen=True)
class Pace:
    """What an environment took.

    Attributes:
        step_ns: One sub-environment's step.
        wake_ns: A step's wait for a sleeping shard beyond that shard's work; None without one.
    """

    step_ns: float
    wake_ns: float | None


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
    fewer = (pace.wake_ns or _WAKE_UP_NS) / pace.step_ns
    sleepers = shards - awake
    small = round((count - awake * fewer) / shards)
    if small < 1 and may_drop:
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
        if not (isinstance(entry, list) and len(entry) == 2 and all(map(_is_sane, entry))):
            return None
        return Pace(*map(float, entry))

    def note(self, env: EnvManifest, pace: Pace) -> None:
        """Remember it. A cache that cannot be written is no error."""
        if self._path is None or not _is_sane(pace.step_ns):
            return
        known = self.of(env)
        wake_ns = pace.wake_ns
        if wake_ns is None or not _is_sane(wake_ns):
            before = known.wake_ns if known is not None and known.wake_ns else _WAKE_UP_NS
            wake_ns = max(before * _FORGETTING, _WAKE_UP_NS)
        self._write({**self._read(), _name(env): [pace.step_ns, wake_ns]})

    def _read(self) -> dict[str, object]:
        try:
            found = json.loads(self._path.read_bytes()) if self._path else {}
        except (OSError, ValueError):
            return {}
        return found if isinstance(found, dict) else {}

    def _write(self, entries: dict[str, object]) -> None:
        assert self._path is not None
        with contextlib.suppress(OSError):
            fd, temporary = tempfile.mkstemp(dir=self._path.parent)
            try:
                with os.fdopen(fd, "w") as file:
                    json.dump(entries, file)
                os.replace(temporary, self._path)
            except BaseException:
                os.unlink(temporary)
                raise


def _name(env: EnvManifest) -> str:
    return json.dumps([env.suite, str(env.task)])


def _is_sane(value: object) -> bool:
    # bool is an int; nan compares false
    return type(value) in (int, float) and 1 <= value < _WORST_NS  # type: ignore[operator]
