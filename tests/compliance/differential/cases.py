"""One random case: what is built, what is called, and where the two sides differ."""

import enum
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

from tests.compliance.differential.scripted import ODD_REWARDS, Scripted
from tests.compliance.differential.spaces import space
from tests.compliance.theirs.through_sandbox import by_value, vector
from tests.support.compare import differences
from tests.support.objects import handed

Call = tuple[str, tuple[Any, ...], dict[str, Any]]


@dataclass(frozen=True)
class Case:
    """What a number stands for."""

    number: int
    env_fns: list[Callable[[], gym.Env[Any, Any]]]
    mode: AutoresetMode
    is_async: bool
    options: dict[str, Any]
    observation_mode: str

    def __str__(self) -> str:
        words = [f"{len(self.env_fns)} sub-environments", self.mode.value, str(self.options)]
        return f"case {self.number}: {', '.join(words)}"


def case(number: int) -> Case:
    draw = Random(number)
    loose, count = draw.random() < 0.4, draw.randrange(1, 6)
    observed, acted = space(draw, loose=loose, least=0), space(draw, loose=loose)
    variety = draw.choice([0.0, 0.0, 0.1, 0.5])
    reuses, odd = draw.random() < 0.3, tuple(draw.sample(list(ODD_REWARDS), 3))
    how = variety, reuses, odd if draw.random() < 0.3 else ()
    options: dict[str, Any] = {"policy": {"lane": draw.choice(["auto", "auto", "frames"])}}
    if draw.random() < 0.2:
        options["env_kwargs"] = {"subclass": True}
    elif draw.random() < 0.2:
        options["sandbox"] = ["process", "process"]
    else:
        options["num_workers"] = draw.randrange(1, 4)
    # its repository's own class is driven as it is: a space without a layout has no async there
    is_async = draw.random() < 0.5 and "env_kwargs" not in options
    mode = draw.choice(list(AutoresetMode))
    observing = "same" if loose else draw.choice(["same", "same", "different"])
    # driven as it is, too: classes by value do not pass its pipes; and of what is reused
    # AsyncVectorEnv sends what is there after the reset
    is_async = is_async and observing != "different" and not reuses
    env_fns = [partial(made, observed, acted, number, index, *how) for index in range(count)]
    return Case(number, list(env_fns), mode, is_async, options, observing)


def made(*args: Any, **kwargs: Any) -> gym.Env[Any, Any]:
    return Scripted(*deepcopy(args), **kwargs)


def calls(drawn: Case, reference: SyncVectorEnv, number: int) -> list[Call]:
    """What is asked of both, with the arguments."""
    draw = Random(f"calls {drawn.number}")
    reference.action_space.seed(drawn.number % 2**31)
    asked: list[Call] = [("reset", (), {"seed": draw.randrange(99)})]
    asked += [_call(draw, reference) for _ in range(number)]
    # what comes again is read in another way than the first time
    return asked + [("call", ("keyed",), {})] * 3


def _call(draw: Random, reference: SyncVectorEnv) -> Call:
    name = draw.choice(["step"] * 8 + ["reset", "reset", *_OTHERS])
    if name == "step":
        actions = reference.action_space.sample()
        return "step", (listed(actions) if draw.random() < 0.3 else actions,), {}
    if name == "reset":
        return "reset", (), _reset(draw, reference.num_envs)
    return _OTHERS[name](draw, reference.num_envs)


def listed(actions: Any) -> Any:
    if isinstance(actions, dict):
        return {key: listed(item) for key, item in actions.items()}
    if isinstance(actions, tuple) and not hasattr(actions, "_fields"):
        return tuple(map(listed, actions))
    return actions.tolist() if isinstance(actions, np.ndarray) and actions.ndim else actions


def _reset(draw: Random, count: int) -> dict[str, Any]:
    seeds = [draw.choice([None, draw.randrange(99)]) for _ in range(count)]
    found: dict[str, Any] = {"seed": draw.choice([None, draw.randrange(99), seeds])}
    options: dict[str, Any] = draw.choice([{}, {"level": draw.randrange(3), "deep": {"x": (1,)}}])
    if draw.random() < 0.5:
        options = options | {"reset_mask": np.array([draw.random() < 0.5 for _ in range(count)])}
    return found | draw.choice([{"options": options}, {"options": options}, {}])


_HANDED = {
    name: value
    for name, value in (handed.PLAIN | handed.PICKLED).items()
    # what is large, or has an address in its repr
    if not name.startswith(("long", "many", "huge", "memoryview", "partial", "Random", "Generator"))
}


def _any(draw: Random) -> Any:
    return _HANDED[draw.choice(list(_HANDED))]


_OTHERS: dict[str, Callable[[Random, int], Call]] = {
    "told": lambda draw, count: ("call", ("told", draw.randrange(9), "x"), {"deep": {"a": [1.5]}}),
    "told of anything": lambda draw, count: ("call", ("told", _any(draw)), {"named": _any(draw)}),
    "held": lambda draw, count: ("set_attr", ("held", [_any(draw) for _ in range(count)]), {}),
    "holds": lambda draw, count: ("call", ("holds",), {}),
    "fails": lambda draw, count: ("call", ("fails", draw.choice(["value", "key", "zero"])), {}),
    "missing": lambda draw, count: ("call", ("not_here",), {}),
    "get_attr": lambda draw, count: ("get_attr", (draw.choice(["note", "number"]),), {}),
    "set_attr": lambda draw, count: (
        "set_attr",
        ("note", draw.choice([[draw.random() for _ in range(count)], "text", 3, None, [1]])),
        {},
    ),
    **{
        name: lambda draw, count, name=name: (name, (), {})
        for name in ("render", "np_random_seed", "np_random")
    },
}


def difference(drawn: Case, number: int, further: dict[str, Any] | None = None) -> str | None:
    """The first difference in words, or None if there is none in so many calls."""
    modes: Any = {"autoreset_mode": drawn.mode, "observation_mode": drawn.observation_mode}
    options = {**drawn.options, **(further or {})}
    with warnings.catch_warnings(), by_value():
        warnings.simplefilter("ignore")
        reference = SyncVectorEnv(drawn.env_fns, **modes)
        env = vector(drawn.env_fns, use_async_envs=drawn.is_async, options=options, **modes)
        try:
            return _first(drawn, reference, env, calls(drawn, reference, number))
        finally:
            env.close()
            reference.close()


def _first(drawn: Case, reference: Any, env: Any, asked: list[Call]) -> str | None:
    draw = Random(f"halves {drawn.number}")
    for position, call in enumerate(asked):
        expected, actual = _outcome(reference, call), _outcome(env, call, draw.random() < 0.3)
        name, args, kwargs = call
        where = f"call {position}, {name}{args[:1] if name != 'step' else ''} {kwargs or ''}"
        if isinstance(expected, Exception) or isinstance(actual, Exception):
            if not _same_failure(drawn, name, expected, actual):
                return f"{where}: expected {expected!r:.500}, got {actual!r:.500}"
            if name in ("step", "reset"):  # half of the sub-environments have been asked
                return None
            continue
        found = next(differences(without_members(expected), actual, where), None)
        if found is not None:
            return found
    return None


def without_members(value: Any) -> Any:
    """A value with the number or text of each enumeration's member that is one."""
    if isinstance(value, enum.Enum) and isinstance(value, (int, str)):
        return value.value
    if isinstance(value, dict):
        return {without_members(key): without_members(item) for key, item in value.items()}
    if type(value) in (list, tuple):
        return type(value)(map(without_members, value))
    if isinstance(value, np.ndarray) and value.dtype.hasobject:
        plain = np.empty(value.shape, object)
        for index in np.ndindex(value.shape):
            plain[index] = without_members(value[index])
        return plain
    return value


def _outcome(env: Any, call: Call, in_halves: bool = False) -> Any:
    """What comes of a call; ``in_halves`` sends it, and waits for it then."""
    name, args, kwargs = deepcopy(call)
    try:
        if in_halves and name in ("reset", "step", "call"):
            getattr(env, f"{name}_async")(*args, **kwargs)
            return getattr(env, f"{name}_wait")()
        found = getattr(env, name)
        return found(*args, **kwargs) if callable(found) else found
    except Exception as error:
        return error


def _same_failure(drawn: Case, name: str, expected: Any, actual: Any) -> bool:
    """Whether both failed alike, and what a call raised says the same.
    That an episode is over is noticed in its own process, while another may fail by itself."""
    if not isinstance(expected, Exception) or not isinstance(actual, Exception):
        return False
    if name == "step" and drawn.mode is AutoresetMode.DISABLED:
        return isinstance(actual, (type(expected), AssertionError))
    if name == "call" and str(expected) not in str(actual):
        return False
    return isinstance(actual, type(expected))
