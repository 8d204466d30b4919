"""Rows apart: ``send`` and ``recv``, resets of some, and what raises in one of them.
The control is a ``SyncVectorEnv`` of each worker's sub-environments, since these are stepped
together. What others do, and who is ready first, must change nothing of what it gives."""

import warnings
from collections import deque
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from random import Random
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import concatenate, create_empty_array

from tests.compliance.differential.cases import Case, made, without_members
from tests.compliance.differential.spaces import flat_space, space
from tests.compliance.theirs.through_sandbox import by_value, vector
from tests.support.compare import differences

_AHEAD = 3
"""Actions in flight for each worker, at most."""


def case(number: int) -> Case:
    draw = Random(f"rows {number}")
    loose, count = draw.random() < 0.3, draw.randrange(1, 6)
    observed, acted = space(draw, loose=loose, least=0), flat_space(draw)
    how = 0.0, draw.random() < 0.3, (), draw.choice([0.0, 0.03, 0.1])
    env_fns = [partial(made, observed, acted, number, index, *how) for index in range(count)]
    options: dict[str, Any] = {"policy": {"lane": draw.choice(["auto", "frames"])}}
    if draw.random() < 0.3:
        options["sandbox"] = ["process"] * draw.randrange(2, 4)
    else:
        options["min_ready"] = 1
        options["num_workers"] = draw.choice([None, 1, 2, 3])
    return Case(number, list(env_fns), draw.choice(list(AutoresetMode)), False, options, "same")


@dataclass
class Slice:
    """The sub-environments of one worker, here, and what is in flight for them."""

    rows: range
    env: SyncVectorEnv
    expected: deque[Any]

    def ask(self, name: str, *args: Any, **kwargs: Any) -> Any:
        """What comes of it: what it returns, or raises."""
        try:
            return deepcopy(getattr(self.env, name)(*args, **kwargs))
        except Exception as error:
            return error

    def last(self) -> Any:
        """The last observation of each, also where the last request failed."""
        single = self.env.single_observation_space
        empty: Any = create_empty_array(single, n=len(self.rows), fn=np.zeros)
        return deepcopy(concatenate(single, self.env._env_obs, empty))


def difference(drawn: Case, number: int, further: dict[str, Any] | None = None) -> str | None:
    with warnings.catch_warnings(), by_value():
        warnings.simplefilter("ignore")
        options = {**drawn.options, **(further or {})}
        env = vector(drawn.env_fns, options=options, autoreset_mode=drawn.mode)
        game = _Game(drawn, env)
        try:
            for position in range(number + 1):
                found = game.play(position)
                if found is not None:
                    return f"call {position}, {found}"
            return None
        finally:
            env.close()
            for one in game.slices:
                one.env.close()


class _Game:
    """Plays both sides."""

    def __init__(self, drawn: Case, env: Any) -> None:
        self._draw = Random(f"calls of rows {drawn.number}")
        self._env, self._mode, self.slices = env, drawn.mode, list[Slice]()
        self._started = False
        env.action_space.seed(drawn.number % 2**31)
        env.call("holds")  # the workers exist, and have not been reset
        whole = {"rows": [0, env.num_envs]}
        for worker in env.sandbox.stats().get("workers", [whole]):
            rows = range(*worker["rows"])
            own = [drawn.env_fns[index] for index in rows]
            reference = SyncVectorEnv(own, autoreset_mode=drawn.mode)
            reference.call("holds")
            self.slices.append(Slice(rows, reference, deque()))

    def play(self, position: int) -> str | None:
        """One call; the difference in words."""
        if not self._started:
            name = "reset"
        else:
            weights = {"step": 4, "send": 6, "recv": 4, "send_reset": 2, "masked": 2, "reset": 1}
            name = self._draw.choices(list(weights), list(weights.values()))[0]
        if name in ("step", "masked", "reset") and self._in_flight():
            found = self._receive_all()
            if found is not None:
                return found
        return getattr(self, f"_{name}")()

    def _in_flight(self) -> list[Slice]:
        return [one for one in self.slices if one.expected]

    def _some(self, slices: list[Slice]) -> list[Slice]:
        return self._draw.sample(slices, self._draw.randrange(1, len(slices) + 1))

    def _ids(self, slices: list[Slice]) -> list[int]:
        ids = [index for one in slices for index in one.rows]
        return self._draw.sample(ids, len(ids))

    def _step(self) -> str | None:
        actions = self._env.action_space.sample()
        expected = [one.ask("step", actions[one.rows.start : one.rows.stop]) for one in self.slices]
        return self._compare_all("step", expected, _asked(self._env.step, actions))

    def _reset(self) -> str | None:
        seed = self._draw.randrange(99)
        expected = [one.ask("reset", seed=[seed + at for at in one.rows]) for one in self.slices]
        actual = _asked(self._env.reset, seed=seed)
        self._started = not isinstance(actual, Exception)
        return self._compare_all("reset", expected, actual)

    def _masked(self) -> str | None:
        mask = np.array([self._draw.random() < 0.5 for _ in range(self._env.num_envs)])
        if self._mode is AutoresetMode.DISABLED:
            mask |= np.concatenate([one.env._terminations for one in self.slices])
            mask |= np.concatenate([one.env._truncations for one in self.slices])
        if not mask.any():
            return None
        seeds = [self._draw.choice([None, self._draw.randrange(99)]) for _ in mask]
        expected = []
        for one in self.slices:
            part = mask[one.rows.start : one.rows.stop]
            if part.any():
                options = {"reset_mask": part, "level": 2}
                own = [seeds[index] for index in one.rows]
                expected.append(one.ask("reset", seed=own, options=options))
            else:
                expected.append((one.last(), {}))
        options = {"reset_mask": mask, "level": 2}
        actual = _asked(self._env.reset, seed=list(seeds), options=options)
        return self._compare_all(f"reset of {mask.tolist()}", expected, actual)

    def _send(self) -> str | None:
        free = [one for one in self.slices if len(one.expected) < _AHEAD]
        if not free:
            return None
        chosen = self._some(free)
        actions, ids = self._env.action_space.sample(), self._ids(chosen)
        self._env.send(actions[ids], ids)
        for one in chosen:
            one.expected.append(one.ask("step", actions[one.rows.start : one.rows.stop]))
        return None

    def _send_reset(self) -> str | None:
        free = [one for one in self.slices if not one.expected]
        if not free:
            return None
        chosen = self._some(free)
        ids = self._ids(chosen)
        seeds = self._draw.choice([None, {index: self._draw.randrange(99) for index in ids}])
        options = self._draw.choice([None, {"level": 1}])
        sent = None if seeds is None else [seeds[index] for index in ids]
        self._env.send_reset(ids, seed=sent, options=options)
        for one in chosen:
            own = None if seeds is None else [seeds[index] for index in one.rows]
            result = one.ask("reset", seed=own, options=options)
            if not isinstance(result, Exception):
                zeros = np.zeros(len(one.rows)), *np.zeros((2, len(one.rows)), np.bool_)
                result = result[0], *zeros, result[1]
            one.expected.append(result)
        return None

    def _receive_all(self) -> str | None:
        while self._in_flight():
            found = self._recv()
            if found is not None:
                return found
        return None

    def _recv(self) -> str | None:
        waiting = self._in_flight()
        if not waiting:
            return None
        least = 1 if len(self.slices) > 1 else self._env.num_envs  # one worker is ready as a whole
        wanted = self._draw.randrange(least, sum(len(one.rows) for one in waiting) + 1)
        received = _asked(self._env.recv, wanted)
        ids = list(getattr(received, "env_ids", ()))
        if not ids:
            return f"recv: got {received!r:.500}"
        for one in [one for one in waiting if one.rows.start in ids]:
            expected = one.expected.popleft()
            if isinstance(received, Exception) or isinstance(expected, Exception):
                if ids != list(one.rows) or not _same_failure(expected, received):
                    return f"recv of {ids}: expected {expected!r:.500}, got {received!r:.500}"
                continue
            places = [ids.index(index) for index in one.rows]
            found = self._compare("recv", one, expected, received[:-1], places)
            if found is not None:
                return found
        return None

    def _compare_all(self, name: str, expected: list[Any], actual: Any) -> str | None:
        """All slices' results with the one of all; of several that raised, the first is raised."""
        raised = [one for one in expected if isinstance(one, Exception)]
        if raised or isinstance(actual, Exception):
            if raised and _same_failure(raised[0], actual):
                return None
            return f"{name}: expected {raised!r:.500}, got {actual!r:.500}"
        for one, result in zip(self.slices, expected, strict=True):
            found = self._compare(name, one, result, actual, list(one.rows))
            if found is not None:
                return found
        return None

    def _compare(
        self, name: str, one: Slice, expected: Any, actual: Any, places: list[int]
    ) -> str | None:
        single = one.env.single_observation_space
        for row, place in enumerate(places):
            both = [
                (_member(single, result[0], at), *_own_columns(result, at))
                for result, at in ((expected, row), (actual, place))
            ]
            where = f"{name} of sub-environment {one.rows[row]}"
            found = next(differences(without_members(both[0]), both[1], where), None)
            if found is not None:
                return found
        return None


def _asked(call: Any, *args: Any, **kwargs: Any) -> Any:
    try:
        return call(*args, **kwargs)
    except Exception as error:
        return error


def _same_failure(expected: Any, actual: Any) -> bool:
    """Whether both raised the same; the text says in which sub-environment, and when."""
    if not isinstance(actual, Exception) or not isinstance(actual, type(expected)):
        return False
    return isinstance(expected, AssertionError) or str(expected) in str(actual)


def _member(single: gym.Space[Any], batched: Any, place: int) -> Any:
    if isinstance(single, spaces.Dict):
        return {key: _member(sub, batched[key], place) for key, sub in single.spaces.items()}
    if isinstance(single, spaces.Tuple):
        return tuple(_member(sub, batched[i], place) for i, sub in enumerate(single.spaces))
    return batched[place]


def _own_columns(result: Any, place: int) -> tuple[Any, ...]:
    """One sub-environment's reward, flags and infos."""
    return *(column[place] for column in result[1:-1]), own_infos(result[-1], place)


def own_infos(infos: dict[Any, Any], place: int) -> dict[Any, Any]:
    """What one sub-environment has of the infos, in values that say nothing of the others."""
    own = {}
    for key, value in infos.items():
        mask = None if str(key).startswith("_") else infos.get(f"_{key}")
        if mask is not None and mask[place]:
            if isinstance(value, dict):
                own[key] = own_infos(value, place)
            else:
                own[key] = (
                    value[place].tolist() if hasattr(value[place], "tolist") else value[place]
                )
    return dict(sorted(own.items(), key=str))
