"""What ``make_env`` returns, with vector environments of this process in it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.vector import SyncVectorEnv

from envhub_sandbox.vector.suites import EnvSuites, keep_only


class _Counted(gym.Env[Any, Any]):
    observation_space = action_space = gym.spaces.Discrete(2)

    def __init__(self, name: str, closed: list[str]) -> None:
        self._name, self._closed = name, closed

    def close(self) -> None:
        self._closed.append(self._name)


def suites(closed: list[str]) -> EnvSuites:
    """Two suites, three tasks, of which one is named by text."""

    def made(name: str) -> Any:
        return SyncVectorEnv([lambda: _Counted(name, closed)])

    return EnvSuites({"a": {0: made("a0"), 1: made("a1")}, "b": {"x": made("bx")}}, dict)


@pytest.mark.parametrize(
    ("suite", "task", "left", "closed"),
    [
        (None, None, {"a": [0, 1], "b": ["x"]}, []),
        ("a", None, {"a": [0, 1]}, ["bx"]),
        ("a", "1", {"a": [1]}, ["a0", "bx"]),
        (None, 0, {"a": [0]}, ["a1", "bx"]),
        (None, "x", {"b": ["x"]}, ["a0", "a1"]),
    ],
)
def test_what_is_not_kept_is_closed(
    suite: str | None, task: Any, left: dict[str, list[Any]], closed: list[str]
) -> None:
    """And is in the mapping no more; a task of a command line is text."""
    ended: list[str] = []
    kept = suites(ended)
    keep_only(kept, suite, task)
    assert {name: list(tasks) for name, tasks in kept.items()} == left
    assert ended == closed
    with pytest.raises(ValueError, match=r"no suite 'a' with a task 'y'"):
        keep_only(kept, "a", "y")
    assert ended == closed, "where nothing could be kept nothing is closed"


def test_a_suite_that_there_is_not_names_those_there_are() -> None:
    """As a ``KeyError``, and only where one asks for it by its name."""
    found = suites([])
    with pytest.raises(KeyError, match="no suite 'c'; there are: 'a', 'b'"):
        found["c"]
    assert found.get("c") is None
    assert "c" not in found
    assert found.reference is None, "nothing could make code of this process again elsewhere"


def test_closing_a_suite_closes_all_of_it() -> None:
    closed = []

    def env(name: str) -> Any:
        def close() -> None:
            closed.append(name)
            if name == "a":
                raise RuntimeError("its close")

        return SimpleNamespace(close=close)

    suites = EnvSuites({"s": {0: env("a"), 1: env("b")}}, dict, lambda: closed.append("last"))
    with pytest.raises(RuntimeError, match="its close"):
        suites.close()
    assert closed == ["a", "b", "last"]
