"""Many tasks at once within a budget: how many live, which is started ahead, and what is raised."""

from __future__ import annotations

import threading
from typing import Any

import pytest

from envhub_sandbox.vector.suites import TaskMap, live_tasks

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
    """Of those that do, one is the next, which was started ahead of its turn."""
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
    """Each waits for two others, so that one after the other would never end.

    Those of sandbox=None, without processes, have nothing that could be started ahead.
    """
    barrier = threading.Barrier(3)
    TaskMap(_suites(6), lambda *_: barrier.wait(DEADLINE_S), 4).run()
    monkeypatch.delattr(_Task, "prewarm")
    found = TaskMap(_suites(4), lambda suite, task, env: task, 2).run()
    assert found == {"a": {0: 0, 1: 1, 2: 2}, "b": {"last": "last"}}


def test_the_first_failure_ends_it() -> None:
    """No further task is begun, all are closed, and what was raised is raised."""
    suites, played = _suites(9), []

    def play(suite: str, task: Any, env: Any) -> None:
        played.append(task)
        if task == 2:
            raise KeyError("this one")

    with pytest.raises(KeyError, match="this one"):
        TaskMap(suites, play, 1).run()
    assert played == [0, 1, 2]
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


def test_a_start_ahead_that_fails_is_raised() -> None:
    suites = _suites(4)

    def refuse() -> None:
        raise OSError("no thread is left")

    suites["a"][1].prewarm = refuse
    with pytest.raises(OSError, match="no thread"):
        TaskMap(suites, lambda *_: None, 2).run()
    assert {env.state for tasks in suites.values() for env in tasks.values()} == {"closed"}


@pytest.mark.parametrize("failure", [RuntimeError("unwilling"), KeyboardInterrupt()])
def test_a_close_that_fails_leaves_no_other_open(failure: BaseException) -> None:
    suites = _suites(4)

    def close() -> None:
        suites["a"][0].state = "closed"
        raise failure

    suites["a"][0].close = close
    with pytest.raises(type(failure)):
        TaskMap(suites, lambda *_: None, 1).run()
    assert {env.state for tasks in suites.values() for env in tasks.values()} == {"closed"}
