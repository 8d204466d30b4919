"""Over how many processes an environment's work is spread: what was fastest when it was tried.

Sub-environments that share a process share its global generators, its module and class attributes,
and whatever else a process has once. So a synchronous environment has one process, as
``SyncVectorEnv``, and an asynchronous one has a process for each sub-environment, as
``AsyncVectorEnv``, unless these were shown to be independent (``runner/independence.py``). Only
then is there a choice, which changes no result.

Each use of a pin cuts its sub-environments into shards in one way, and notes how long a step took.
The first uses try one way after the other, those that follow have the fastest. Fewer shards win
where they are nearly as fast: they take less memory, and start sooner. All is tried again where the
number of cores is another one, or where the same way has become much slower or faster: the load is
another one then, or the machine.
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
"""Fewer steps say nothing about speed."""
ENOUGH_STEPS = 512
"""After so many steps their time is noted, and once more at the end."""
_NEARLY = 1.03
"""So much slower counts as equal."""
HOPELESS = 1.2
"""Where half as many shards are so much slower than the best, still fewer are not tried."""
_ANOTHER_LOAD = 1.5
"""So much slower or faster than the last time is no noise."""

Bounds = list[tuple[int, int]]


class ShardTrials:
    """How long the steps of the environments of one manifest took, in a file beside it.
    ``path``: the file, or None for what must not be remembered.
    ``apart``: whether sub-environments that seemed to be independent were found not to be.
    """

    def __init__(self, path: Path | None, *, apart: bool = False) -> None:
        self._path = path
        self._apart = apart
        self._cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1

    def bounds_for(self, env: EnvManifest, num_workers: int | None) -> Bounds:
        """The slices of the sub-environments, one for each of ``num_workers`` shards, or of as
        many as are useful.
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
        """Whether sub-environments in one process give the same as with a process each."""
        return env.sync or (env.independent and not self._apart)

    def note(self, env: EnvManifest, bounds: Bounds, step_s: float) -> None:
        """Remember what a step took. A cache that cannot be written is no error."""
        chosen = not env.sync and env.num_envs > 1 and self.may_share(env)
        if self._path is None or not chosen or not _is_sane(step_s):
            return  # it must not be remembered, or there is no choice
        entries = self._read()
        times, name = self._times(entries, env), _name(bounds)
        slower = step_s / times.get(name, step_s)
        if slower * _ANOTHER_LOAD < 1:
            times = {}
        elif slower > _ANOTHER_LOAD:  # what was far slower on a quieter machine is so here, too
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
    """The ways that are tried, in their order: a shard for each core first, a single one last."""
    most = max(1, min(count, cores))
    ways = [even_bounds(count, most)]
    less = count // most * 3 // 4
    if most == cores > 1 and less:  # the last one shares its core with the client
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
