"""Plays an environment with seeded actions and keeps a trace: a digest of each step, to compare.

The play also checks each step's results: members of the observation space, shapes of masks, finite
numbers, times."""

from __future__ import annotations

import hashlib
import itertools
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv

from envhub_sandbox.extras.judge.play.members import check_observations
from envhub_sandbox.play.episodes import Episode, EpisodeCounter, RolloutError, on_cpu
from envhub_worker.protocol.codec.inert import RemoteObject
from envhub_worker.protocol.spaces import batches
from envhub_worker.protocol.text import printable

Env = VectorEnv[Any, Any, Any]
_NOTED, _LONGEST = 3, 200
_LAST = ("final_obs", "final_observation")
_KEPT_BYTES, _PART_BYTES = 32 << 20, 400
"""Bytes of results to keep in all, and Python's overhead for each part of a result."""
_MOST_ENDS = 1000
_PARTS = ("the observation", "the reward", "terminated", "truncated")


@dataclass
class Trace:
    """The record of a play.

    Attributes:
        steps: A digest of the reset, and of every step.
        actions: A digest of the actions of every step.
        notes: The first few faults of steps, for each check.
        heavy: Bytes of the infos of each step, per sub-environment.
        episodes: How many ended.
        times: Seconds of the reset and of steps, for the report.
        counted: The details of ended episodes; fewer if a reward cannot be counted.
        spent: Seconds of each step.
        ends: Short keys of infos at the ends of episodes, up to a number.
        results: The results of the reset and of each step, without infos, up to a size in all.
    """

    steps: list[str] = field(default_factory=list)
    actions: list[str] = field(default_factory=list)
    notes: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))
    heavy: list[float] = field(default_factory=list)
    episodes: int = 0
    times: dict[str, float] = field(default_factory=dict)
    counted: list[Episode] = field(default_factory=list)
    spent: list[float] = field(default_factory=list)
    ends: set[str] = field(default_factory=set)
    results: list[dict[str, Any]] = field(default_factory=list)
    _left: int = _KEPT_BYTES

    def add(self, result: Sequence[Any], resumed: str = "") -> None:
        """Add a reset's observations or a step's results."""
        self.steps.append(resumed + digest(result[0] if len(result) == 1 else tuple(result)))
        parts = dict(itertools.chain.from_iterable(map(_named, _PARTS, result)))
        self._left -= sum(_PART_BYTES + len(name) + _weight(part) for name, part in parts.items())
        if self._left >= 0:
            self.results.append({name: copy(value) for name, value in parts.items()})

    def note(self, check: str, text: str) -> None:
        """Keep a fault, unless the check already has enough."""
        if len(self.notes[check]) < _NOTED:
            self.notes[check].append(text)

    def differs_from(self, other: Trace) -> int | None:
        """Returns the first step that differs, 0 for the reset; None if none does."""
        pairs = enumerate(zip(self.steps, other.steps, strict=False))
        return next((number for number, (mine, theirs) in pairs if mine != theirs), None)

    def difference(self, other: Trace, at: int) -> str:
        """Returns ``": "`` and the difference at a step; empty if a trace lacks its results."""
        kept = at < min(len(self.results), len(other.results))
        seen = differing(self.results[at], other.results[at]) if kept else ""
        return f": {seen}" if seen else ""


def play(
    env: Env,
    mode: str | None,
    *,
    seed: int,
    steps: int,
    actions_seed: int | None = None,
    like: Trace | None = None,
    observe: Callable[[int], None] = lambda number: None,
) -> Trace:
    """Resets and steps with seeded random actions; returns the trace.

    Args:
        seed: The environment's seed, and that of the actions unless ``actions_seed`` is set.
        like: A trace; the play stops at the first step that differs from it.
        observe: Called with the number of each finished step; 0 is the reset.

    Raises:
        OutsideSpaceError: An observation is outside its space.
    """
    counter, counts = EpisodeCounter(env.num_envs, env.num_envs * steps, mode), True
    trace, ended = Trace(counted=counter.counted), np.zeros(env.num_envs, np.bool_)
    env.action_space.seed(seed if actions_seed is None else actions_seed)
    began = time.perf_counter()
    first = env.reset(seed=seed)[0]
    trace.times = {"reset_s": time.perf_counter() - began}
    check_observations(env, "reset", first)
    _look_at(trace, first, "the reset")
    trace.add([first])
    observe(0)
    for number in range(1, steps + 1):
        if like is not None and trace.steps[-1] != like.steps[len(trace.steps) - 1]:
            break
        resumed = ""
        if mode == "Disabled" and ended.any():
            observations = env.reset(options={"reset_mask": ended})[0]
            check_observations(env, "reset", observations)
            resumed = digest(observations)
        actions = env.action_space.sample()
        trace.actions.append(digest(actions))
        begun = time.perf_counter()
        result = env.step(actions)
        trace.spent.append(time.perf_counter() - begun)
        check_observations(env, "step", result[0], result[4].get("final_obs"))
        trace.add(result[:4], resumed)  # infos may hold times
        ended = _judge(trace, result, ended, mode, number)
        if counts:
            try:
                counter.step(*result[1:])
            except RolloutError:
                counts = False
        observe(number)
    trace.times |= _times(trace.spent)
    return trace


def _times(spent: list[float]) -> dict[str, float]:
    if not spent:
        return {}
    median, late = np.quantile(spent, (0.5, 0.99))
    return {
        "step_mean_s": sum(spent) / len(spent),
        "step_median_s": float(median),
        "step_p99_s": float(late),
        "step_slowest_s": max(spent),
    }


def _judge(trace: Trace, result: tuple[Any, ...], ended: Any, mode: str | None, number: int) -> Any:
    observations, rewards, terminations, truncations, infos = result
    _look_at(trace, observations, f"step {number}")
    trace.heavy.append(_bytes_of(infos) / max(len(rewards), 1))
    for text in _masks(infos, len(rewards)):
        trace.note("infos", f"step {number}: {text}")
    for text in itertools.islice(_foreign(infos), 1):
        trace.note("info-types", f"step {number}: {text}")
    done = np.logical_or(np.asarray(terminations, bool), np.asarray(truncations, bool))
    trace.episodes += int(done.sum())
    if done.any():
        keys = {key for group in (infos, infos.get("final_info")) for key in _texts(group)}
        trace.ends |= set(itertools.islice(keys, _MOST_ENDS - len(trace.ends)))
    if not np.isfinite(np.asarray(rewards, np.float64)).all():
        trace.note("rewards", f"step {number}: {np.asarray(rewards).tolist()}")
    if mode == "NextStep":
        for index in np.flatnonzero(ended):
            if done[index] or np.any(np.asarray(rewards)[index]):
                trace.note(
                    "autoreset",
                    f"step {number}: sub-environment {index} had ended, and the step that resets "
                    "it has a reward or ends it again (NEXT_STEP)",
                )
    if mode == "SameStep" and done.any() and "final_obs" not in infos:
        trace.note("autoreset", f"step {number}: an episode ended without 'final_obs' (SAME_STEP)")
    return done


def _look_at(trace: Trace, observations: Any, where: str) -> None:
    for found in itertools.islice(_unbounded(observations), 1):
        trace.note("observation-finite", f"{where}: an observation has {found}")


def _leaves(value: Any, without: Collection[str] = ()) -> Iterator[Any]:
    """Yields the values inside mappings, sequences and object arrays.

    Trust: input from the worker; decoding has bounded its depth and size.
    """
    if isinstance(value, Mapping):
        value = [value[name] for name in value if name not in without]
    elif isinstance(value, np.ndarray) and value.dtype == object:
        value = list(value.flat)
    if isinstance(value, (list, tuple)):
        for item in value:
            yield from _leaves(item, without)
    else:
        yield value


def _foreign(infos: Mapping[Any, Any]) -> Iterator[str]:
    """Yields a text for each value in infos that the worker could only describe."""
    for name, value in infos.items():
        for leaf in _leaves(value, _LAST) if name not in _LAST else ():
            if isinstance(leaf, RemoteObject):
                yield f"info {name!r} has a {leaf.type_name}: {leaf.text}"


def _texts(infos: Any) -> set[str]:
    keys = infos if isinstance(infos, Mapping) else ()
    return {key for key in keys if isinstance(key, str) and len(key) <= _LONGEST}


def _named(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yields a result's leaves with their names, cut: the worker chooses the length of keys."""
    if isinstance(value, Mapping):
        for key in value:
            yield from _named(f"{name}[{key!r}]"[:_LONGEST], value[key])
    elif isinstance(value, (list, tuple)):
        for index, one in enumerate(value):
            yield from _named(f"{name}[{index}]", one)
    else:
        yield name, on_cpu(value)


def differing(one: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """Returns the first difference of two results in words. Trust: the worker's values."""
    for name, value in one.items():
        another = other.get(name)
        if digest(value) != digest(another):
            return f"{printable(name, _LONGEST)}{_values(value, another)}"
    return ""


def _values(one: Any, other: Any) -> str:
    """Returns the first difference of two arrays, with its row; else both values in short."""
    arrays = isinstance(one, np.ndarray) and isinstance(other, np.ndarray)
    if arrays and one.ndim and one.shape == other.shape and one.dtype == other.dtype != object:
        same = (one == other) | ((one != one) & (other != other))
        for row, *rest in np.argwhere(~same)[:1].tolist():
            at = (row, *rest)
            return f"{rest or ''} of sub-environment {row} is {one[at]!s} and {other[at]!s}"
    return f" is {batches.shown(one)} and {batches.shown(other)}"


def _unbounded(observations: Any) -> Iterator[str]:
    """Yields the non-finite values in observations."""
    for leaf in _leaves(observations):
        value = on_cpu(leaf)
        if isinstance(value, (float, np.ndarray, np.generic)):
            array = np.asarray(value)
            if array.dtype.kind in "fc" and not np.isfinite(array).all():
                yield "NaN" if np.isnan(array).any() else "infinity"


def _bytes_of(infos: Any) -> int:
    """Returns the approximate size of infos, without the last observation of an episode."""
    return sum(map(_weight, _leaves(infos, _LAST)))


def _weight(leaf: Any) -> int:
    if isinstance(leaf, np.ndarray):
        return leaf.nbytes
    return len(leaf) if isinstance(leaf, (str, bytes)) else 8


def _masks(infos: Mapping[Any, Any], count: int) -> Iterator[str]:
    """Yields faults of masks in infos; a value without a mask is about all. Trust: the worker's."""
    for name, mask in infos.items():
        value = infos.get(name[1:]) if isinstance(name, str) and name.startswith("_") else None
        if value is None or not isinstance(mask, np.ndarray):
            continue
        if mask.shape != (count,) or mask.dtype != np.bool_:
            yield f"{name!r} is {mask.dtype} {mask.shape}, of {count} sub-environments"
        elif isinstance(value, Mapping):
            yield from _masks(value, count)
        elif isinstance(value, np.ndarray) and value.shape[:1] != (count,):
            yield f"{name[1:]!r} is {value.shape}, of {count} sub-environments"


def digest(value: Any) -> str:
    """Returns equal digests for values that are equal bit for bit: arrays, numbers, containers."""
    hashed = hashlib.sha256()
    _feed(hashed, value)
    return hashed.hexdigest()


def _feed(hashed: Any, value: Any) -> None:
    value = on_cpu(value)
    if isinstance(value, np.ndarray) and value.dtype != object:
        hashed.update(f"array {value.dtype.str} {value.shape}".encode())
        hashed.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, Mapping):
        hashed.update(f"mapping {len(value)}".encode())
        for key in sorted(value, key=repr):
            _feed(hashed, key)
            _feed(hashed, value[key])
    elif isinstance(value, (list, tuple, np.ndarray)):
        hashed.update(f"items {len(value)}".encode())
        for item in value:
            _feed(hashed, item)
    else:
        hashed.update(f"{type(value).__name__} {value!r}".encode("utf-8", "replace"))
