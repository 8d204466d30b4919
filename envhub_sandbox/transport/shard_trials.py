"""Chooses over how many processes to spread an environment, by trials of what is fastest.

Sub-environments in one process share its global generators, its module and class attributes, and
all other state that a process has once. So a synchronous environment has one process, as with
``SyncVectorEnv``, and an asynchronous environment has a process for each sub-environment, as with
``AsyncVectorEnv``. Only if the sub-environments were shown to be independent
(``runner/independence.py``), this module may choose another number, which changes no result.

Each use of a pin cuts its sub-environments into shards in one way, and notes the time of a step.
The first uses try one way after the other; later uses take the fastest. If fewer shards are nearly
as fast, they win, because they take less memory and start sooner. The trials begin again if the
number of cores changes, or if the same way becomes much slower or faster, because then the load or
the machine has changed.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Sequence
from pathlib import Path

from envhub_sandbox.system.folders import write_whole_file
from envhub_worker.protocol.manifest.manifest import EnvManifest
from envhub_worker.protocol.spaces.batches import even_bounds

LEAST_STEPS = 32
"""A use with fewer steps notes no time, because they say nothing about speed."""
ENOUGH_STEPS = 512
"""The time of a step is noted after so many steps, and again when the environment closes."""
_NEARLY = 1.03
"""A way that is slower by at most this factor counts as equally fast."""
HOPELESS = 1.2
"""If half as many shards are slower than the best by this factor, fewer are not tried."""
_ANOTHER_LOAD = 1.5
"""A change of the time by more than this factor is not noise."""

Bounds = list[tuple[int, int]]


class ShardTrials:
    """The step times of one manifest's environments, in a file beside the manifest.
    ``path``: the file, or None to remember nothing.
    ``apart``: whether sub-environments that seemed independent were later found to share state.
    """

    def __init__(self, path: Path | None, *, apart: bool = False) -> None:
        self._path = path
        self._apart = apart
        self._cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1

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
        times = self._times(self._read(), env)
        tried: list[tuple[float, Bounds]] = []
        for bounds in ways_to_cut(env.num_envs, self._cores):
            step_s = times.get(_name(bounds))
            if step_s is None:
                return bounds
            tried.append((step_s, bounds))
            if 2 * len(bounds) <= len(tried[0][1]) and step_s > HOPELESS * min(tried)[0]:
                break
        enough = _NEARLY * min(tried)[0]
        return [bounds for step_s, bounds in tried if step_s <= enough][-1]

    def may_share(self, env: EnvManifest) -> bool:
        """Whether sub-environments give the same results in one process as in one each."""
        return env.sync or (env.independent and not self._apart)

    def note(self, env: EnvManifest, bounds: Bounds, step_s: float) -> None:
        """Remember the time of a step. Failing to write the cache is no error."""
        chosen = not env.sync and env.num_envs > 1 and self.may_share(env)
        if self._path is None or not chosen or not _is_sane(step_s):
            return  # the time must not be remembered, or there is no choice
        entries = self._read()
        times, name = self._times(entries, env), _name(bounds)
        slower = step_s / times.get(name, step_s)
        if slower * _ANOTHER_LOAD < 1:
            times = {}
        elif slower > _ANOTHER_LOAD:  # keep, scaled, only ways that were far slower anyway
            far = {
                key: seconds
                for key, seconds in times.items()
                if seconds > times[name] * _ANOTHER_LOAD
            }
            times = {key: seconds * slower for key, seconds in far.items()}
        entries[self._key(env)] = {**times, name: step_s}
        with contextlib.suppress(OSError):
            write_whole_file(self._path, json.dumps(entries).encode())

    def _key(self, env: EnvManifest) -> str:
        return json.dumps([env.suite, str(env.task), self._cores])

    def _times(self, entries: dict[str, object], env: EnvManifest) -> dict[str, float]:
        entry = entries.get(self._key(env))
        times = entry if isinstance(entry, dict) else {}
        return {name: step_s for name, step_s in times.items() if _is_sane(step_s)}

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


def _name(bounds: Sequence[tuple[int, int]]) -> str:
    return "+".join(str(stop - start) for start, stop in bounds)


def _is_sane(value: object) -> bool:
    # bool is an int; nan compares false
    return type(value) is float and 0 < value < 1e6
