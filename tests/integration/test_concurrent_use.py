"""Two threads that use one environment at once: the second is told so, the first goes on."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from gymnasium.error import AlreadyPendingCallError

from envhub_sandbox import make_env
from envhub_sandbox.errors import WorkerTimeoutError
from tests.support import inside
from tests.support.samples import SAMPLES

ACTIONS = np.zeros(2, np.int64)
DEADLINE_S = 60.0


@pytest.fixture(params=["auto", "frames"])
def env(request: pytest.FixtureRequest) -> Iterator[Any]:
    """A vector environment that has been reset."""
    with make_env(str(SAMPLES / "cartpole"), n_envs=2, lane=request.param) as suites:
        suites.env.reset(seed=0)
        yield suites.env


def held_between_the_halves(env: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Any]:
    """Have another thread step, and stop it once that was sent; returns what lets it go on."""
    requests, stopped, go_on = inside.session(env).requests, threading.Event(), threading.Event()
    collect, results = requests.collect_step, []

    def slow(timeout_s: float | None = None) -> Any:
        stopped.set()
        assert go_on.wait(DEADLINE_S)
        return collect(timeout_s)

    monkeypatch.setattr(requests, "collect_step", slow)
    thread = threading.Thread(target=lambda: results.append(env.step(ACTIONS)), name="rollout")
    thread.start()
    assert stopped.wait(DEADLINE_S)

    def finish() -> Any:
        monkeypatch.undo()
        go_on.set()
        thread.join(DEADLINE_S)
        return results[0]

    return finish


@pytest.mark.parametrize("asks", ["step", "reset", "get_attr"])
def test_the_second_thread_is_told(env: Any, monkeypatch: pytest.MonkeyPatch, asks: str) -> None:
    """It names the first, whose results come, and nothing is late."""
    finish = held_between_the_halves(env, monkeypatch)
    arguments = {"step": (ACTIONS,), "reset": (), "get_attr": ("gravity",)}[asks]
    with pytest.raises(AlreadyPendingCallError, match="'rollout' is using this environment"):
        getattr(env, asks)(*arguments)
    assert finish()[0].shape == (2, 4)
    assert env.step(ACTIONS)[0].shape == (2, 4)


def test_what_nobody_waits_for_is_late(env: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The control: an interrupt between the halves, and no other thread."""

    def interrupted(timeout_s: float | None = None) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(inside.session(env).requests, "collect_step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        env.step(ACTIONS)
    monkeypatch.undo()
    with pytest.raises(WorkerTimeoutError, match="the last step was interrupted"):
        env.step(ACTIONS)
    env.reset(seed=0)
    env.step(ACTIONS)
