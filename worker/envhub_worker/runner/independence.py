"""Tests whether the sub-environments of an asynchronous environment may share a process.

``AsyncVectorEnv`` gives each sub-environment a process. Several in one process give the same
results only if none of them changes state that a process has once. No static check shows that, so
this module tries it: forks of the runner play the sub-environments, once all together and once each
alone, with equal seeds and actions. They may share a process if every observation, reward, flag and
info is bitwise equal and ``SharedState`` sees no change. Sub-environments that cannot be played in
time are heavy and gain nothing from sharing; nor do those that wait instead of computing, since
sub-environments in one process wait one after the other.

The forks run after ``make_env`` returns and before the first sub-environment is built, where
``AsyncVectorEnv`` forks, too. They run one at a time, so no more sub-environments live at once than
in use. This process does not change; files that the forks write go with the jail, which the client
does not use again.

Two plays would differ if they read a clock or the system's entropy: ``RecordEpisodeStatistics``
puts an elapsed time into infos, and a sub-environment may own an unseeded generator. Neither makes
one sub-environment depend on another. So in the forks both come from counters, one set for each
sub-environment.
"""

from __future__ import annotations

import contextlib
import copy
import hashlib
import os
import random
import re
import resource
import select
import signal
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from math import inf
from time import monotonic, process_time
from types import SimpleNamespace
from typing import Any

import numpy as np
from gymnasium.vector.utils import concatenate, create_empty_array

from envhub_worker.protocol import messages as m
from envhub_worker.runner.described import described
from envhub_worker.runner.state.shared_state import SharedState
from envhub_worker.runner.sync_envs import SubEnvs
from envhub_worker.runner.tasks import Task

_BUILD_S = 2.0
"""Processor time in which all sub-environments of a task are built and reset, or it is heavy."""
_LEAST_STEPS, _MOST_STEPS = 16, 256
_LEAST_STEPS_S, _MOST_STEPS_S = 1.0, 0.25
"""Processor time in which the first are made, or it is heavy, and after which no further one is."""
_LONGEST_SLEEP_S = 60.0
"""Longest sleep of one call by a play's own clock. A call that polls for another process
would never end, because sleeping takes no real time in a play."""
_WAIT_S, _LEAST_SHARE = 2.0, 8
"""How long all plays may wait, in seconds and as a multiple of their processor time: on a busy
machine a play waits for a processor, too.
"""
_STEPS_AFTER_RESET = 8
_ALONE = 4
"""So many of the first sub-environments, and of the last, are played alone."""
_SEED = 20_261
_DIGEST_BYTES = 16
_STEP_BYTES = 4
_EPOCH_NS = time.time_ns()
"""Where the clocks of all plays begin."""
_ADDRESS = re.compile(rb"0x[0-9a-f]{4,}")
"""In the text of an object that has no other."""


class Budget:
    """The time and memory that all plays of a ``make_env`` may take.

    Args:
        until: When to give up, by ``time.monotonic``.
        most_bytes: Memory that a play may take: more could end the whole jail.

    Attributes:
        most_bytes: Memory that a play may take.
    """

    def __init__(self, until: float, most_bytes: int) -> None:
        self._until, self._wait_s, self.most_bytes = until, _WAIT_S, most_bytes

    def left_s(self, began: float, pid: int) -> float:
        """Returns how long the fork that ``began`` then may still wait without computing."""
        now, computed_s = monotonic(), 0.0
        with contextlib.suppress(OSError):  # it has ended. Followed: clock_getcpuclockid(3)
            computed_s = time.clock_gettime(~pid << 3 | 2)
        return min(self._until - now, self._wait_s - (now - began) + _LEAST_SHARE * computed_s)

    def take(self, left_s: float) -> None:
        """Charge a fork that has ended with this much time left."""
        self._wait_s = min(self._wait_s, left_s)


def are_independent(task: Task, root: str, budget: Budget) -> bool:
    """Play a task's sub-environments together and apart, and compare.

    Args:
        task: A task whose recording has built no sub-environment yet.
        root: The repository's folder.
        budget: The time and memory that the plays may take.
    """
    count = task.num_envs
    together = in_fork(partial(_play, task, range(count), None, root), count, budget)
    if together is None:
        return False
    steps = int.from_bytes(together[:_STEP_BYTES], "little")
    starts = range(_STEP_BYTES, len(together), _DIGEST_BYTES)
    digests = [together[start:][:_DIGEST_BYTES] for start in starts]
    for index in sorted({*range(count)[:_ALONE], *range(count)[-_ALONE:]}):
        alone = in_fork(partial(_play, task, [index], steps, root), 1, budget)
        if alone is None or alone[_STEP_BYTES:] != digests[index]:
            return False
    return True


def in_fork(play: Callable[[], bytes], count: int, budget: Budget) -> bytes | None:
    """Runs a play in a fork of this process; returns its steps and ``count`` digests.
    None if the play fails or takes too much time or memory.
    """
    source, sink = os.pipe()
    try:
        with warnings.catch_warnings():  # of threads, which are not in the fork
            warnings.simplefilter("ignore")
            pid = os.fork()
    except OSError:  # no more processes
        os.close(source)
        os.close(sink)
        return None
    if pid == 0:
        _play_and_exit(play, sink, budget.most_bytes)
    os.close(sink)
    left_s = partial(budget.left_s, monotonic(), pid)
    try:
        return _read(source, _STEP_BYTES + count * _DIGEST_BYTES, left_s)
    finally:
        budget.take(left_s())
        os.close(source)
        with contextlib.suppress(OSError):  # with all that it has started
            os.killpg(pid, signal.SIGKILL)
        with contextlib.suppress(OSError):
            os.kill(pid, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):  # the repository may reap its children itself
            os.waitpid(pid, 0)


def _play_and_exit(play: Callable[[], bytes], sink: int, most_bytes: int) -> None:
    try:
        os.setpgid(0, 0)
        # It may take this many more bytes of memory than it shares with this process.
        with open("/proc/self/statm") as file:
            data_pages = int(file.read().split()[5])
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        most = data_pages * resource.getpagesize() + most_bytes
        resource.setrlimit(resource.RLIMIT_DATA, (most if hard < 0 else min(most, hard), hard))
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        os.write(sink, play())
    finally:
        os._exit(0)


def _read(source: int, size: int, left_s: Callable[[], float]) -> bytes | None:
    """Reads a number of bytes; None if they do not come in time. Do not wait for the end of the
    pipe: processes that the repository has started may hold it open.
    """
    data = b""
    poller = select.poll()
    poller.register(source, select.POLLIN)
    while len(data) < size and (wait_s := left_s()) > 0:
        if poller.poll(wait_s * 1000 + 1):
            part = os.read(source, size - len(data))
            if not part:
                return None
            data += part
    return data if len(data) == size else None


class HeavyError(Exception):
    """A play takes more than its time."""


def _play(task: Task, indices: Sequence[int], steps: int | None, root: str) -> bytes:
    """Plays sub-environments; returns the number of steps and a digest of each one's results.

    ``steps``: how many to play; None for as many as fit into the time. Raises if a sub-environment
    cannot be played, takes too long, or changes state that a process has once.
    """
    assert task.recording is not None
    turns, moved = Turns(), list[str]()
    turns.replace_sources()
    state = SharedState(root, moved.append)
    turns.most_s = _BUILD_S if steps is None else inf
    build = [partial(turns.run, index, partial(task.build_one, index)) for index in indices]
    envs = SubEnvs(build, task.recording.autoreset_mode, sync=False, sliced=True)
    # Each sub-environment is reset and stepped in its turn.
    envs.driven = [
        SimpleNamespace(
            reset=partial(turns.run, index, env.reset), step=partial(turns.run, index, env.step)
        )
        for index, env in zip(indices, envs.envs, strict=True)
    ]
    state.built(envs.envs)
    play = _Play(envs, indices)
    play.reset([_SEED + index for index in indices])
    turns.most_s = inf
    play.step()
    state.look_closely()
    count = play.step_on(steps)
    play.reset(None)
    for _ in range(_STEPS_AFTER_RESET):
        play.step()
    state.look_closely()
    if moved:
        raise RuntimeError(f"shared: {moved}")
    return count.to_bytes(_STEP_BYTES, "little") + b"".join(
        digest.digest() for digest in play.digests
    )


class _Play:
    """Plays sub-environments and digests the results of each."""

    def __init__(self, envs: SubEnvs, indices: Sequence[int]) -> None:
        self._envs = envs
        self.digests = [hashlib.blake2b(digest_size=_DIGEST_BYTES) for _ in indices]
        self._actions = [copy.deepcopy(envs.single_action_space) for _ in indices]
        for space, index in zip(self._actions, indices, strict=True):
            space.seed(_SEED + index)

    def reset(self, seeds: list[int] | None, mask: Any = None) -> None:
        """Reset them, or those of the mask."""
        self._note(self._envs.run_reset(seeds, None, mask))

    def step_on(self, steps: int | None) -> int:
        """Step this many times, or as often as the time allows; returns the number of steps.
        Raises ``HeavyError``: the time allows too few steps.
        """
        if steps is not None:
            for _ in range(steps):
                self.step()
            return steps
        began_s = process_time()
        for count in range(_MOST_STEPS):
            passed_s = process_time() - began_s
            if count < _LEAST_STEPS and passed_s > _LEAST_STEPS_S:
                raise HeavyError
            if count >= _LEAST_STEPS and passed_s > _MOST_STEPS_S:
                return count
            self.step()
        return _MOST_STEPS

    def step(self) -> None:
        """Step all, each with its own actions; reset ended episodes if nothing else resets them."""
        envs, space = self._envs, self._envs.single_action_space
        members = [space.sample() for space in self._actions]
        empty: Any = create_empty_array(space, n=len(members), fn=np.zeros)
        self._note(envs.run_step(concatenate(space, members, empty)))
        ended = envs.batch.terminations | envs.batch.truncations
        if envs.resets_nothing and ended.any():
            self.reset(None, ended)

    def _note(self, infos: list[tuple[int, Any]]) -> None:
        batch, by_row = self._envs.batch, [list[Any]() for _ in self.digests]
        for row, info in infos:
            by_row[row].append(info)
        members = batch.members()
        for row, digest in enumerate(self.digests):
            observation = members[row]
            if type(observation) is np.ndarray and not observation.dtype.hasobject:
                digest.update(f"{observation.dtype} {observation.shape}".encode())
                digest.update(observation.tobytes())
            else:
                _add(digest, observation)
            flags = int(batch.terminations[row]), int(batch.truncations[row])
            digest.update(batch.rewards[row].tobytes() + bytes(flags))
            if by_row[row]:
                _add(digest, by_row[row])


def _add(digest: hashlib.blake2b, value: object) -> None:
    frames = m.pack(m.Value(value), describer=described, reduces=True)
    digest.update(_ADDRESS.sub(b"0x", bytes(frames[0])))
    for frame in frames[1:]:
        digest.update(frame)


_OURS = -1
"""No sub-environment's turn: copies of spaces take entropy, too."""


class Turns:
    """The current turn, with a clock and a source of entropy for each sub-environment."""

    def __init__(self) -> None:
        self.most_s = inf
        self._index = _OURS  # the sub-environment whose turn it is
        self._slept_s = 0.0  # in this turn, on the main thread
        self._ticks: Counter[int] = Counter()  # each one's clock, in nanoseconds
        self._draws: Counter[int] = Counter()  # how often each one has drawn entropy

    def run(self, index: int, call: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Call a sub-environment's method in its turn. Raises ``HeavyError``: it takes too long."""
        if process_time() > self.most_s:
            raise HeavyError
        self._index, self._slept_s = index, 0.0
        try:
            return call(*args, **kwargs)
        finally:
            self._index = _OURS

    def replace_sources(self) -> None:
        """Replace clocks and entropy in this process for good. Code that holds a reference to an
        original function keeps it.
        """
        seed = random.Random.seed
        for name in ("time", "monotonic", "perf_counter", "process_time"):
            setattr(time, f"{name}_ns", lambda: _EPOCH_NS + self._tick(1_000_000))
            setattr(time, name, lambda: (_EPOCH_NS + self._tick(1_000_000)) / 1e9)
        time.sleep = self._sleep
        os.urandom = random._urandom = self._entropy  # type: ignore[attr-defined]

        def seeded(generator: random.Random, a: Any = None, *args: Any, **kwargs: Any) -> None:
            seed(generator, self._entropy(16) if a is None else a, *args, **kwargs)

        random.Random.seed = seeded  # type: ignore[assignment]

    def _tick(self, nanoseconds: int) -> int:
        self._ticks[self._index] += nanoseconds
        return self._ticks[self._index]

    def _sleep(self, seconds: Any) -> None:
        self._tick(int(seconds * 1e9))
        if threading.current_thread() is threading.main_thread():  # others may have a loop to run
            self._slept_s += seconds
            if self._slept_s > _LONGEST_SLEEP_S:
                raise HeavyError

    def _entropy(self, size: int) -> bytes:
        self._draws[self._index] += 1
        key = f"{self._index} {self._draws[self._index]}".encode()
        return hashlib.shake_128(key).digest(size)
