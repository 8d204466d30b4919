"""Chooses over how many processes to spread an environment, by trials of what is fastest.

Sub-environments in one process share its global generators, its module and class attributes, and
all other state that a process has once. So a synchronous environment has one process, as with
``SyncVectorEnv``, and an asynchronous environment has a process for each sub-environment, as with
``AsyncVectorEnv``. Only if the sub-environments were shown to be independent
(``runner/independence.py``), this module may choose another number, which changes no result.

Each use of a pin cuts its sub-environments into shards in one way, and notes the time of a step.
The first uses try each way, and a second time what was not far slower; later uses take the fastest.
If fewer shards are nearly as fast, they win, because they take less memory and start sooner. Other
processes only ever slow steps down, so the time of a way is the shortest of its last uses. A load
that lasts may make another way the fastest. So after several slow uses in a row, all earlier ones
are forgotten, and all ways are tried again; likewise if the number of cores changes, or if the last
use of a way is long ago.
"""

from __future__ import annotations

import contextlib
import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from envhub_sandbox.system.folders import write_whole_file
from envhub_sandbox.system.platform import own_cpus
from envhub_worker.protocol.manifest.manifest import EnvManifest
from envhub_worker.protocol.spaces.batches import even_bounds

LEAST_STEPS = 32
"""A use with fewer steps notes no time, because they say nothing about speed."""
ENOUGH_STEPS = 512
"""The time of a step is noted after so many steps, and again when the environment closes."""
_NEARLY = 1.05
"""A way that is slower by at most this factor counts as equally fast."""
HOPELESS = 1.2
"""If half as many shards are slower than the best by this factor, fewer are not tried."""
_TRIALS = 2
"""The least number of times to try each way."""
_NOISE = 1.3
"""A way that seemed slower by more than this factor is not tried a second time."""
_LOADED = 1.5
"""A use is slow if its steps took longer than the shortest of the same way by this factor."""
_LASTS = 4
"""So many slow uses in a row are no noise, but a load that lasts."""
_KEPT = 64
"""The number of last notes that are remembered."""
_LONGEST_S = 1e6
"""A longer step is an error of the clock, or of the file."""

Bounds = list[tuple[int, int]]
Note = tuple[str, float]
"""The name of a way to cut, and the time of a step in one use of it."""


class ShardTrials:
    """The step times of one manifest's environments, in a file beside the manifest.
    ``path``: the file, or None to remember nothing.
    ``apart``: whether sub-environments that seemed independent were later found to share state.
    """

    def __init__(self, path: Path | None, *, apart: bool = False) -> None:
        self._path = path
        self._apart = apart
        self._noted: Note | None = None
        self._cores = len(own_cpus())

    def bounds_for(self, env: EnvManifest, num_workers: int | None) -> Bounds:
        """The slices of the sub-environments, one for each shard: ``num_workers`` shards if given,
        else as many as the trials say.
        """
        if not env.shardable or (num_workers is None and env.sync):
            return even_bounds(env.num_envs, 1)
        if num_workers is not None:
            return even_bounds(env.num_envs, max(1, min(num_workers, env.num_envs)))
        if not self.may_share(env):
            return even_bounds(env.num_envs, env.num_envs)
        return _choose(ways_to_cut(env.num_envs, self._cores), self._notes(self._read(), env))

    def may_share(self, env: EnvManifest) -> bool:
        """Whether sub-environments give the same results in one process as in one each."""
        return env.sync or (env.independent and not self._apart)

    def note(self, env: EnvManifest, bounds: Bounds, step_s: float) -> None:
        """Remember the time of a step. Failing to write the cache is no error."""
        chosen = not env.sync and env.num_envs > 1 and self.may_share(env)
        if self._path is None or not chosen or not 0 < step_s < _LONGEST_S:
            return  # nothing can be remembered, or there was no choice of processes
        entries = self._read()
        notes = [note for note in self._notes(entries, env) if note != self._noted]
        self._noted = (_name(bounds), step_s)  # the later note of a use replaces the earlier
        notes = [*notes, self._noted][-_KEPT:]
        shortest, last = _shortest(notes), notes[-_LASTS:]
        slow = [step_s > _LOADED * shortest[name] for name, step_s in last]
        entries[self._key(env)] = last if slow == [True] * _LASTS else notes
        with contextlib.suppress(OSError):
            write_whole_file(self._path, json.dumps(entries).encode())

    def _key(self, env: EnvManifest) -> str:
        return json.dumps([env.suite, str(env.task), self._cores])

    def _notes(self, entries: dict[str, object], env: EnvManifest) -> list[Note]:
        entry = entries.get(self._key(env))
        notes = entry if type(entry) is list else []
        return [(note[0], note[1]) for note in notes if _is_note(note)]

    def _read(self) -> dict[str, object]:
        try:
            content = json.loads(self._path.read_bytes()) if self._path else {}
        except (OSError, ValueError):
            return {}
        return content if isinstance(content, dict) else {}


def ways_to_cut(count: int, cores: int) -> list[Bounds]:
    """The ways to cut, in the order of trials: from a shard for each core down to one shard."""
    most = max(1, min(count, cores))
    ways = [even_bounds(count, most)]
    less = count // most * 3 // 4
    if most == cores > 1 and less:  # the last shard shares its core with the client
        ways.append([*even_bounds(count - less, most - 1), (count - less, count)])
    if most == cores > 2:
        ways.append(even_bounds(count, most - 1))
    while most > 1:
        most //= 2
        ways.append(even_bounds(count, most))
    return ways


def _choose(ways: list[Bounds], notes: list[Note]) -> Bounds:
    """The way for the next use, after uses with these notes."""
    times, trials = _shortest(notes), Counter(name for name, _ in notes)
    tried: list[tuple[float, Bounds]] = []
    for bounds in ways:
        step_s = times.get(_name(bounds))
        if step_s is None:
            return bounds
        tried.append((step_s, bounds))
        if 2 * len(bounds) <= len(ways[0]) and step_s > HOPELESS * min(tried)[0]:
            break
    fastest_s = min(tried)[0]
    for step_s, bounds in tried:
        if trials[_name(bounds)] < _TRIALS and step_s <= _NOISE * fastest_s:
            return bounds
    return [bounds for step_s, bounds in tried if step_s <= _NEARLY * fastest_s][-1]


def _shortest(notes: Sequence[Note]) -> dict[str, float]:
    return dict(sorted(notes, key=lambda note: note[1], reverse=True))


def _name(bounds: Sequence[tuple[int, int]]) -> str:
    return "+".join(str(stop - start) for start, stop in bounds)


def _is_note(note: object) -> bool:
    if type(note) is not list or [*map(type, note)] != [str, float]:
        return False
    return bool(0 < note[1] < _LONGEST_S)  # nan compares false
