"""Brings the result of ``make_env`` into one form: tasks by suite and task id.

Followed: LeRobot's ``_normalize_hub_result``. This module also handles results that LeRobot gets
wrong: a single ``Env`` with ``n_envs > 1``, ``{suite: VectorEnv}``, ``{suite: [env, ...]}``,
duck-typed vector environments.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv

from envhub_worker.protocol.manifest.manifest import TaskId
from envhub_worker.protocol.spaces.differing import Pair, differing
from envhub_worker.runner import gymnasium_compat as compat
from envhub_worker.runner.foreign import old_gym
from envhub_worker.runner.recording import Recording, recording
from envhub_worker.runner.sync_envs import SubEnvs
from envhub_worker.runner.vector_spaces import (
    MissingSpaceError,
    Sides,
    VectorSpaces,
    row_of,
    spaces_of,
)

EnvFn = Callable[[], Any]
Picker = Callable[[Any], Any]
_DUCK = ("num_envs", "reset", "step", "close")


class ResultError(Exception):
    """``make_env`` returned something that is not an environment."""


@dataclass
class Task:
    """One entry of the mapping: a recording that can be built in slices, or a live environment."""

    suite: str
    task: TaskId
    recording: Recording | None = None
    vector: Any = None
    probe: Any = None
    """The first sub-environment, when it has been built to learn its spaces."""
    spaces: VectorSpaces | None = None
    """Those of a live environment, once they are known."""
    independent: bool = False
    """Whether its sub-environments were shown to change nothing for one another."""

    @property
    def may_share(self) -> bool:
        """Whether sub-environments of an ``AsyncVectorEnv`` may have to share a process."""
        return self.recording is not None and not self.recording.sync and self.num_envs > 1

    def is_unlike_gymnasium(self, count: int) -> bool:
        """Whether a process has ``count`` sub-environments, and Gymnasium's class another number:
        ``SyncVectorEnv`` all, ``AsyncVectorEnv`` one.
        """
        recording = self.recording
        return recording is not None and count != (self.num_envs if recording.sync else 1)

    @property
    def num_envs(self) -> int:
        """The number of sub-environments."""
        return len(self.recording.env_fns) if self.recording else int(self.vector.num_envs)

    def build(self, start: int, stop: int) -> Any:
        """Builds a vector environment of the sub-environments ``start`` to ``stop``."""
        if self.recording is None:
            return self.vector
        built = [self.probe] if start == 0 and self.probe is not None else []
        self.probe = None if built else self.probe
        envs = [*built, *map(self.build_one, range(start + len(built), stop))]
        self._refuse_differing(envs, start)
        env_fns: list[EnvFn] = [partial(_itself, env) for env in envs]
        sliced = stop - start < len(self.recording.env_fns)
        recording = self.recording
        return SubEnvs(
            env_fns, recording.autoreset_mode, recording.sync, sliced=sliced, start=start
        )

    def _refuse_differing(self, envs: list[Any], start: int) -> None:
        """Raise Gymnasium's error if the sub-environments have different spaces."""
        assert self.recording is not None
        sync, pairs = self.recording.sync, [_spaces_of(env) for env in envs]
        text = differing(sync, pairs)
        if text and start:  # the text names the first sub-environment of the whole task
            text = differing(sync, [_spaces_of(self.learn_spaces()), *pairs])
        if text:
            raise RuntimeError(text)

    def learn_spaces(self) -> Any:
        """Returns one sub-environment of a recording, to read spaces and metadata from."""
        if self.probe is None:
            self.probe = self.build_one(0)
        return self.probe

    def vector_spaces(self, sides: Sides) -> VectorSpaces:
        """Returns the spaces of a live environment.
        Raises ``ResultError``: it neither declares them nor shows them in its first reset.
        """
        if self.spaces is None:
            try:
                self.spaces = spaces_of(self.vector, sides)
            except MissingSpaceError as error:
                raise ResultError(
                    f"make_env returned {_described(self.vector)}: add {error} to it, the space of "
                    "one sub-environment; it has none from which it could be derived"
                ) from None
        return self.spaces

    def build_one(self, index: int) -> Any:
        """Builds a sub-environment, adapted to Gymnasium's interface."""
        assert self.recording is not None
        return old_gym.adapted(self.recording.env_fns[index]())


def _itself(env: Any) -> Any:
    return env


def _spaces_of(env: Any) -> Pair:
    return env.observation_space, env.action_space


def tasks_of(result: Any, n_envs: int, use_async_envs: bool, again: EnvFn) -> list[Task]:
    """Returns the tasks in the result of ``make_env``.

    ``again`` calls ``make_env`` with ``n_envs=1`` to get one more single ``Env``.
    Raises ``ResultError``: the result, or something in it, is not an environment.
    """
    make = _Maker(n_envs, use_async_envs, again)
    if not isinstance(result, Mapping):
        is_known = isinstance(result, (gym.Env, VectorEnv)) or old_gym.is_env(result)
        spec = getattr(result, "spec", None) if is_known else None
        suite = str(getattr(spec, "id", None) or "hub_env")
        return [make.task(suite, 0, result, lambda value: value)]
    tasks = [make.task(suite, task, env, pick) for suite, task, env, pick in _entries(result)]
    if not tasks:
        raise ResultError("make_env returned an empty mapping, without an environment")
    return tasks


def _entries(result: Mapping[Any, Any]) -> Iterator[tuple[str, TaskId, Any, Picker]]:
    for suite, group in result.items():
        if not isinstance(suite, str):
            raise ResultError(f"a suite's name is a str, make_env used {_described(suite)}")
        if isinstance(group, Mapping):
            for task, env in group.items():
                yield suite, _task_id(task), env, _picker(suite, task)
        elif isinstance(group, (list, tuple)):
            for index, env in enumerate(group):
                yield suite, index, env, _picker(suite, index)
        else:
            yield suite, 0, group, _picker(suite)


def _picker(*path: Any) -> Picker:
    def pick(result: Any) -> Any:
        for key in path:
            result = result[key]
        return result

    return pick


def _task_id(task: Any) -> TaskId:
    if isinstance(task, (int, np.integer)) and not isinstance(task, bool):
        return int(task)
    if isinstance(task, str):
        return task
    raise ResultError(f"a task id is an int or a str, make_env used {_described(task)}")


class _Maker:
    """Makes tasks; single environments are multiplied by calling ``make_env`` again."""

    def __init__(self, n_envs: int, use_async_envs: bool, again: EnvFn) -> None:
        self._n_envs = n_envs
        self._sync = not use_async_envs
        self._again = again
        self._seen: list[Any] = []

    def task(self, suite: str, task: TaskId, env: Any, pick: Picker) -> Task:
        if isinstance(env, VectorEnv) or _is_duck(env) or _has_single_spaces(env):
            record = recording(env)
            return Task(suite, task, recording=record, vector=None if record else env)
        if old_gym.is_vector(env):
            return Task(suite, task, vector=old_gym.adapted_vector(env))
        if isinstance(env, gym.Env) or old_gym.is_env(env):
            _refuse_batched(env)
            return Task(suite, task, recording=self._multiplied(env, pick))
        if isinstance(env, type):
            raise ResultError(
                f"make_env returned the class {env.__qualname__}; return an environment of it, as "
                f"in `return {env.__qualname__}()`"
            )
        lacks = [name for name in _DUCK if not hasattr(env, name)]
        if not {"reset", "step"} & {*lacks}:
            raise ResultError(
                f"make_env returned {_described(env)}, which has reset and step: to pass as a "
                f"vector environment, add {', '.join(lacks)}; or derive it from gymnasium.Env or "
                "gymnasium.vector.VectorEnv"
            )
        raise ResultError(
            f"make_env must return a gymnasium VectorEnv, an Env, or a mapping "
            f"{{suite: {{task_id: VectorEnv}}}}; for suite {suite!r}, task {task!r} it returned "
            f"{_described(env)}"
        )

    def _multiplied(self, first: Any, pick: Picker) -> Recording:
        def another() -> Any:
            env = pick(self._again())
            if any(env is seen for seen in self._seen):
                raise ResultError(
                    f"make_env returns the same Env object each time, so n_envs={self._n_envs} "
                    "cannot be honoured; use n_envs=1, or return a VectorEnv"
                )
            if _spaces_of(env) != _spaces_of(first):
                raise ResultError(
                    f"make_env returned {_described(first)} for n_envs={self._n_envs}, and an Env "
                    f"with other spaces for n_envs=1: {_spaces_of(first)} and {_spaces_of(env)}. "
                    "If it steps several environments, return a gymnasium.vector.VectorEnv"
                )
            self._seen.append(env)
            return env

        self._seen.append(first)
        env_fns: list[EnvFn] = [lambda: first, *[another] * (self._n_envs - 1)]
        return Recording(env_fns=env_fns, sync=self._sync, autoreset_mode="NextStep", arguments={})


def _is_duck(env: Any) -> bool:
    if isinstance(env, (gym.Env, type)) or old_gym.is_env(env):
        return False
    return all(hasattr(env, name) for name in _DUCK)


def _has_single_spaces(env: Any) -> bool:
    """Whether a ``gym.Env`` is a vector environment without that base, as in many simulators."""
    names = ("num_envs", "single_observation_space", "single_action_space")
    return isinstance(env, gym.Env) and all(hasattr(env, name) for name in names)


def _refuse_batched(env: Any) -> None:
    """Raise ``ResultError`` if an ``Env`` or a layer of it steps several environments at once.

    A vector of such environments would have one dimension too many without any error.
    """
    for layer in compat.layers(env):
        count = getattr(layer, "num_envs", None)
        if _has_single_spaces(layer) or (
            isinstance(count, (int, np.integer)) and _is_batched(layer, int(count))
        ):
            raise ResultError(
                f"make_env returned {_described(env)}, a gym.Env whose num_envs is {count} and "
                "whose spaces are batched. Return a gymnasium.vector.VectorEnv, or give it "
                "single_observation_space and single_action_space, and put no gym.Wrapper around it"
            )


def _is_batched(env: Any, count: int) -> bool:
    """Whether the spaces are batched. A dimension of 1 may be a channel: then both must have it."""
    own = (old_gym.space_of(getattr(env, name)) for name in _SPACES)
    observed, acted = (row_of(space, count) is not None for space in own)
    return observed and (acted or count > 1)


_SPACES = ("observation_space", "action_space")


def _described(value: Any) -> str:
    if value is None:
        return "None"
    text = repr(value)
    kind = f"{type(value).__module__}.{type(value).__qualname__}"
    return f"{text[:80]} (a {kind})"
