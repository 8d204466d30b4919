"""One random case: what is built, what is called, and where the two sides differ."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from random import Random
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from tests.compliance.differential.scripted import Scripted
from tests.compliance.differential.spaces import space
from tests.compliance.theirs.through_sandbox import vector
from tests.support.compare import differences

Call = tuple[str, tuple[Any, ...], dict[str, Any]]


@dataclass(frozen=True)
class Case:
    """What a number stands for.

    Attributes:
        env_fns: One for each sub-environment.
        mode: The autoreset mode.
        is_async: Whether the repository makes an ``AsyncVectorEnv``.
        options: What else ``make_env`` is told.
    """

    number: int
    env_fns: list[Callable[[], gym.Env[Any, Any]]]
    mode: AutoresetMode
    is_async: bool
    options: dict[str, Any]

    def __str__(self) -> str:
        words = [f"{len(self.env_fns)} sub-environments", self.mode.value, str(self.options)]
        return f"case {self.number}: {', '.join(words)}"


def case(number: int) -> Case:
    """The case of a number: the same in each run."""
    draw = Random(number)
    loose, count = draw.random() < 0.4, draw.randrange(1, 6)
    observed, acted = space(draw, loose=loose), space(draw, loose=loose)
    variety = draw.choice([0.0, 0.0, 0.1, 0.5])
    env_fns = [partial(made, observed, acted, number, index, variety) for index in range(count)]
    options: dict[str, Any] = {"lane": draw.choice(["auto", "auto", "frames"])}
    if draw.random() < 0.2:
        options["env_kwargs"] = {"subclass": True}
    else:
        options["num_workers"] = draw.randrange(1, 4)
    # its repository's own class is driven as it is: a space without a layout has no async there
    is_async = draw.random() < 0.5 and "env_kwargs" not in options
    return Case(number, list(env_fns), draw.choice(list(AutoresetMode)), is_async, options)


def made(*args: Any) -> gym.Env[Any, Any]:
    """A sub-environment; spaces are its own."""
    return Scripted(*deepcopy(args))


def calls(drawn: Case, reference: SyncVectorEnv, number: int) -> list[Call]:
    """What is asked of both, with the arguments."""
    draw = Random(f"calls {drawn.number}")
    reference.action_space.seed(drawn.number % 2**31)
    asked: list[Call] = [("reset", (), {"seed": draw.randrange(99)})]
    return asked + [_call(draw, reference) for _ in range(number)]


def _call(draw: Random, reference: SyncVectorEnv) -> Call:
    name = draw.choice(["step"] * 8 + ["reset", "reset", *_OTHERS])
    if name == "step":
        return "step", (reference.action_space.sample(),), {}
    if name == "reset":
        return "reset", (), _reset(draw, reference.num_envs)
    return _OTHERS[name](draw, reference.num_envs)


def _reset(draw: Random, count: int) -> dict[str, Any]:
    seeds = [draw.choice([None, draw.randrange(99)]) for _ in range(count)]
    found: dict[str, Any] = {"seed": draw.choice([None, draw.randrange(99), seeds])}
    options: dict[str, Any] = draw.choice([{}, {"level": draw.randrange(3), "deep": {"x": (1,)}}])
    if draw.random() < 0.5:
        options = options | {"reset_mask": np.array([draw.random() < 0.5 for _ in range(count)])}
    return found | draw.choice([{"options": options}, {"options": options}, {}])


def _each(draw: Random, count: int) -> Call:
    values: Any = draw.choice([[draw.random() for _ in range(count)], "text", 3, None, [1]])
    return "set_attr", ("note", values), {}


_OTHERS: dict[str, Callable[[Random, int], Call]] = {
    "told": lambda draw, count: ("call", ("told", draw.randrange(9), "x"), {"deep": {"a": [1.5]}}),
    "fails": lambda draw, count: ("call", ("fails", draw.choice(["value", "key", "zero"])), {}),
    "missing": lambda draw, count: ("call", ("not_here",), {}),
    "get_attr": lambda draw, count: ("get_attr", (draw.choice(["note", "number"]),), {}),
    "set_attr": _each,
    "render": lambda draw, count: ("render", (), {}),
    "np_random_seed": lambda draw, count: ("np_random_seed", (), {}),
    "np_random": lambda draw, count: ("np_random", (), {}),
}


def difference(drawn: Case, number: int) -> str | None:
    """The first difference in words, or None if there is none in so many calls."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reference = SyncVectorEnv(drawn.env_fns, autoreset_mode=drawn.mode)
        env = vector(
            drawn.env_fns,
            use_async_envs=drawn.is_async,
            options=drawn.options,
            autoreset_mode=drawn.mode,
        )
        try:
            return _first(reference, env, calls(drawn, reference, number))
        finally:
            env.close()
            reference.close()


def _first(reference: Any, env: Any, asked: list[Call]) -> str | None:
    for position, call in enumerate(asked):
        expected, actual = _outcome(reference, call), _outcome(env, call)
        name, args, kwargs = call
        where = f"call {position}, {name}{args[:1] if name != 'step' else ''} {kwargs or ''}"
        if isinstance(expected, Exception) or isinstance(actual, Exception):
            if not _same_failure(expected, actual):
                return f"{where}: expected {expected!r:.500}, got {actual!r:.500}"
            if name in ("step", "reset"):  # half of the sub-environments have been asked
                return None
            continue
        found = next(differences(expected, actual, where), None)
        if found is not None:
            return found
    return None


def _outcome(env: Any, call: Call) -> Any:
    name, args, kwargs = deepcopy(call)
    try:
        found = getattr(env, name)
        return found(*args, **kwargs) if callable(found) else found
    except Exception as error:
        return error


def _same_failure(expected: Any, actual: Any) -> bool:
    """Whether both failed alike; that some episode is over may be noticed at another moment."""
    over = isinstance(actual, AssertionError)
    return isinstance(expected, Exception) and (over or isinstance(actual, type(expected)))
