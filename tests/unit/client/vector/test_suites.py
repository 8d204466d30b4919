"""What ``make_env`` returns, with vector environments of this process in it."""

import threading
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.vector import SyncVectorEnv

from envhub_sandbox.vector.suites import EnvSuites, TaskMap, keep_only, live_tasks


class _Counted(gym.Env[Any, Any]):
    observation_space = action_space = gym.spaces.Discrete(2)

    def __init__(self, name: str, closed: list[str]) -> None:
        self._name, self._closed = name, closed

    def close(self) -> None:
        self._closed.append(self._name)


def suites(closed: list[str]) -> EnvSuites:
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


# --- Many tasks at once within a budget: how many live, which is started ahead, and what is raised


DEADLINE_S = 60.0
GIB = 1 << 30


class _Task:
    """An environment, as far as this concerns it; all together note how many live."""

    living = 0
    most = 0
    lock = threading.Lock()

    def __init__(self) -> None:
        self.state = "new"

    def live(self) -> None:
        with self.lock:
            if self.state == "new":
                self.state = "live"
                _Task.living += 1
                _Task.most = max(_Task.most, _Task.living)

    prewarm = live

    def close(self) -> None:
        with self.lock:
            _Task.living -= self.state == "live"
            self.state = "closed"


def _suites(count: int) -> dict[str, dict[Any, Any]]:
    _Task.living = _Task.most = 0
    return {"a": {n: _Task() for n in range(count - 1)}, "b": {"last": _Task()}}


@pytest.mark.parametrize("live", [1, 2, 3, 40])
def test_no_more_live_than_were_asked_for(live: int) -> None:
    ahead: list[str] = []

    def play(suite: str, task: Any, env: Any) -> str:
        ahead.append(env.state)
        env.live()
        return f"{suite} {task}"

    found = TaskMap(_suites(12), play, live).run()
    assert found == {"a": {n: f"a {n}" for n in range(11)}, "b": {"last": "b last"}}
    assert list(found["a"]) == list(range(11)), "in the order of the suite"
    assert _Task.most <= live
    assert _Task.living == 0
    assert ahead.count("live") == (11 if 1 < live < 12 else 0)


def test_several_are_played_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each waits for two others, so that one after the other would never end. Those of
    sandbox=None, without processes, have nothing that could be started ahead."""
    barrier = threading.Barrier(3)
    TaskMap(_suites(6), lambda *_: barrier.wait(DEADLINE_S), 4).run()
    monkeypatch.delattr(_Task, "prewarm")
    found = TaskMap(_suites(4), lambda suite, task, env: task, 2).run()
    assert found == {"a": {0: 0, 1: 1, 2: 2}, "b": {"last": "last"}}


@pytest.mark.parametrize("failure", [KeyError("this one"), KeyboardInterrupt()])
@pytest.mark.parametrize("fails", ["play", "prewarm", "close"])
def test_the_first_failure_ends_it(fails: str, failure: BaseException) -> None:
    """Of a play, a start ahead or a close: no other task begins, all are closed, it is raised."""
    suites, played = _suites(9), []

    def fail() -> None:
        suites["a"][2].state = "closed" if fails == "close" else "new"
        raise failure

    def play(suite: str, task: Any, env: Any) -> None:
        played.append(task)
        if fails == "play" and task == 2:
            fail()

    if fails != "play":
        setattr(suites["a"][2], fails, fail)
    with pytest.raises(type(failure)):
        TaskMap(suites, play, 2 if fails == "prewarm" else 1).run()
    assert played == ([0] if fails == "prewarm" else [0, 1, 2])
    assert {env.state for tasks in suites.values() for env in tasks.values()} == {"closed"}


@pytest.mark.parametrize(
    ("memory", "most", "why"),
    [
        (None, None, "takes max_live_tasks"),
        (None, 0, "at least 1"),
        ("1G", None, "one task may take 4"),
        ("1G", 2, "one task may take 4"),
    ],
)
def test_bounds_that_permit_nothing_are_refused(memory: Any, most: Any, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        live_tasks(memory, most, 4 * GIB)
    assert live_tasks("16G", None, 4 * GIB) == 4
    assert live_tasks(16 * GIB, 3, 4 * GIB) == 3
    assert live_tasks(None, 7, 0) == 7
