"""Asynchronous sub-environments that share something of their process, or do not.
The control is Gymnasium's ``AsyncVectorEnv`` in this process, which gives each a process of its
own. How many processes the sandbox uses is found out by it."""

import importlib.util
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from envhub_sandbox import make_env
from tests.support.compare import differences

REPOSITORY = Path(__file__).parent / "repository"
KINDS = (
    *("numpy", "random", "module", "class", "first of class", "list", "default", "cache"),
    *("environment", "iterator", "generator", "legacy generator"),
)
_fresh = count()


@dataclass(frozen=True)
class Case:
    """What a number stands for."""

    number: int
    n_envs: int
    kwargs: dict[str, Any]
    options: dict[str, Any]

    def __str__(self) -> str:
        return f"case {self.number}: {self.n_envs} sub-environments, {self.kwargs}, {self.options}"


def case(number: int) -> Case:
    draw = Random(f"sharing {number}")
    kwargs = {
        "kinds": draw.sample(KINDS, draw.choice([0, 1, 1, 2])),
        "length": draw.choice([3, 9, 500]),
        "every": draw.choice([1, 1, 4, 12]),
        "told": draw.random() < 0.3,
        "mode": draw.choice(["NextStep", "SameStep", "Disabled"]),
    }
    options: dict[str, Any] = {"policy": {"lane": draw.choice(["auto", "auto", "frames"])}}
    if draw.random() < 0.2:
        options["sandbox"] = ["process", "process"]
    return Case(number, draw.randrange(2, 5), kwargs, options)


def difference(drawn: Case, number: int, further: dict[str, Any] | None = None) -> str | None:
    """The first difference in words, or None if there is none in so many calls.
    The sandbox is used twice: in its first use it has just been tried how many processes are used,
    and in the second one that is remembered."""
    here = _module().make_env(drawn.n_envs, True, **drawn.kwargs)
    expected = _played(here, drawn, number)
    for use in ("first", "second"):
        options: dict[str, Any] = {**drawn.options, **(further or {}), "env_kwargs": drawn.kwargs}
        with make_env(REPOSITORY, drawn.n_envs, True, **options) as suites:
            actual = _played(suites.env, drawn, number)
        for position, pair in enumerate(zip(expected, actual, strict=True)):
            found = next(differences(*pair, f"{use} use, call {position}"), None)
            if found is not None:
                return found
    return None


def _module() -> Any:
    """The repository's module, as a process sees it that has just imported it."""
    path = REPOSITORY / "env.py"
    spec = importlib.util.spec_from_file_location(f"sharing_{next(_fresh)}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _played(env: Any, drawn: Case, steps: int) -> list[Any]:
    """What a seeded reset, and steps and resets of some, return. Closes it."""
    draw = Random(f"calls of sharing {drawn.number}")
    results = [env.reset(seed=draw.randrange(99))]
    for position in range(steps):
        actions = np.array([draw.randrange(3) for _ in range(drawn.n_envs)])
        results.append(env.step(actions))
        mask = results[-1][2] | results[-1][3]
        if drawn.kwargs["mode"] != "Disabled" or position == steps // 2:
            mask = mask | np.array([draw.random() < 0.02 for _ in range(drawn.n_envs)])
        if mask.any():
            results.append(env.reset(seed=draw.choice([None, 7]), options={"reset_mask": mask}))
    env.close()
    return [(*result[:-1], dict(sorted(result[-1].items()))) for result in results]
