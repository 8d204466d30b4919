"""What a repository's objects are, before anything of theirs is called."""

import functools
from typing import Any
from unittest.mock import Mock

import gymnasium as gym
import numpy as np
import pytest

from envhub_worker.runner import gymnasium_compat, manifest, tasks


def takes_all(a: int, /, b: int, *, c: int = 0, **others: int) -> None:
    """A function with each kind of parameter."""


def test_parameters_that_can_be_given_by_name() -> None:
    """One that goes by position alone cannot; ``**others`` takes any, and has none of them."""
    found = gymnasium_compat.parameters_of(takes_all)
    assert [gymnasium_compat.names(found, name) for name in "abcd"] == [False, True, True, False]
    assert [gymnasium_compat.takes(found, name) for name in "abcd"] == [True] * 4
    bound = gymnasium_compat.parameters_of(functools.partial(takes_all, 1))
    assert "a" not in bound
    plain = gymnasium_compat.parameters_of(lambda n_envs: None)
    assert plain is not None
    assert not gymnasium_compat.takes(plain, "use_async_envs")


@pytest.mark.parametrize("odd", [dict.__init__, type("Odd", (), {"__signature__": 3})(), 7])
def test_what_python_cannot_tell_is_none(odd: Any) -> None:
    found = gymnasium_compat.parameters_of(odd)
    assert found is None or "kwargs" in found


class Inner(gym.Env[Any, Any]):
    """With a step that does nothing."""

    observation_space = action_space = gym.spaces.Discrete(2)
    depth = "inner"

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return 0, {}

    def step(self, action: Any) -> Any:
        return 0, 0.0, False, False, {}


class Outer(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper with an attribute of its own."""

    height = "outer"


def test_layers_are_walked_from_the_outside() -> None:
    """And an attribute belongs to the one that has it itself, else to the outermost."""
    inner = Inner()
    wrapped = Outer(gym.wrappers.TimeLimit(inner, 3))
    layers = list(gymnasium_compat.layers(wrapped))
    assert (layers[0], layers[-1], len(layers)) == (wrapped, inner, 3)
    assert gymnasium_compat.owner(wrapped, "depth") is inner
    assert gymnasium_compat.owner(wrapped, "height") is wrapped
    assert gymnasium_compat.owner(wrapped, "nothing_of_this_name") is wrapped


def test_ancestors_are_found_by_name() -> None:
    assert gymnasium_compat.descends_from(Inner(), "gymnasium.core", "Env")
    assert not gymnasium_compat.descends_from(Inner(), "torch.nn", "Module")


def many(n_envs: int = 2) -> gym.vector.SyncVectorEnv:
    return gym.vector.SyncVectorEnv([Inner] * n_envs)


@pytest.mark.parametrize(
    ("returned", "names"),
    [
        (many, [("hub_env", 0)]),
        (Inner, [("hub_env", 0)]),
        (lambda: {"a": {0: many(), "b": many()}}, [("a", 0), ("a", "b")]),
    ],
)
def test_results_become_tasks(returned: Any, names: list[tuple[str, Any]]) -> None:
    found = tasks.tasks_of(returned(), 2, False, returned)
    assert [(one.suite, one.task) for one in found] == names
    made = manifest.describe(found)
    assert [(one.suite, one.task) for one in made.envs] == names
    assert all(one.num_envs == 2 for one in made.envs)


@pytest.mark.parametrize(
    ("returned", "named"),
    [
        *(
            (None, "None"),
            ([1, 2], "list"),
            (Inner, r"the class Inner; .*`return Inner\(\)`"),
            ([many], "list"),
        ),
        *(({}, "empty"), ({"a": {}}, "without an environment"), ({"a": {0: 42}}, "42")),
        *(({"a": None}, "None"), ({("a", "b"): {0: None}}, "tuple")),
    ],
)
def test_what_is_no_environment_is_named(returned: Any, named: str) -> None:
    with pytest.raises(tasks.ResultError, match=f"make_env.*{named}"):
        tasks.tasks_of(returned, 2, False, lambda: returned)


def test_the_same_environment_twice_is_no_vector() -> None:
    only = Inner()
    [task] = tasks.tasks_of(only, 2, False, lambda: only)
    with pytest.raises(tasks.ResultError, match="the same Env object"):
        task.build(0, 2)


def test_columns_of_an_old_numpy_are_arrays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Arrays of numpy before 1.22 have no ``__dlpack__``; a masked array is refused there, too."""

    def has(value: Any, name: str) -> bool:
        return name != "__dlpack__" and hasattr(value, name)

    monkeypatch.setattr(gymnasium_compat, "hasattr", has, raising=False)
    env = Mock(num_envs=2)
    step = (np.zeros((2, 3)), np.ones(2), np.zeros(2, bool), [False, True], {})
    assert gymnasium_compat.step_result(env, step)[1] is step[1]
    with pytest.raises(TypeError, match="as rewards"):
        gymnasium_compat.step_result(env, (step[0], np.ma.ones(2), *step[2:]))
