"""Two threads that use one environment at once: the second waits, and close does not."""

import threading
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from gymnasium.error import AlreadyPendingCallError

from envhub_sandbox import make_env
from tests.support import inside
from tests.support.samples import SAMPLES

ACTIONS = np.zeros(2, np.int64)
DEADLINE_S = 60.0


@pytest.fixture(params=["auto"])
def env(request: pytest.FixtureRequest) -> Iterator[Any]:
    with make_env(str(SAMPLES / "cartpole"), n_envs=2, policy={"lane": request.param}) as suites:
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


over_both_lanes = pytest.mark.parametrize("env", ["auto", "frames"], indirect=True)


@over_both_lanes
def test_the_second_thread_waits(env: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing of it is sent before the first has its results; then both have theirs."""
    for asks, arguments in (("step", (ACTIONS,)), ("reset", ()), ("get_attr", ("gravity",))):
        finish = held_between_the_halves(env, monkeypatch)
        sent, results = env.sandbox.stats()["requests"], list[Any]()

        def ask(into: list[Any] = results, name: str = asks, given: Any = arguments) -> None:
            into.append(getattr(env, name)(*given))

        second = threading.Thread(target=ask)
        second.start()
        assert not getattr(*inside.use_lock(env)).acquire(blocking=False)
        assert (env.sandbox.stats()["requests"], results) == (sent, [])
        assert finish()[0].shape == (2, 4)
        second.join(DEADLINE_S)
        assert (len(results), env.step(ACTIONS)[0].shape) == (1, (2, 4))


def test_two_threads_that_step_are_warned_of(env: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once, although both get their results in turn; a thread after another is none of it, and one
    that asks amid an asynchronous call is refused."""
    refused: list[type] = []

    def step() -> None:
        try:
            env.step(ACTIONS)
        except AlreadyPendingCallError as error:
            refused.append(type(error))

    def step_elsewhere() -> threading.Thread:
        thread = threading.Thread(target=step)
        thread.start()
        return thread

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        step_elsewhere().join(DEADLINE_S)
        env.step(ACTIONS)
    finish = held_between_the_halves(env, monkeypatch)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        second = step_elsewhere()
        until = time.monotonic() + DEADLINE_S
        while not caught and time.monotonic() < until:
            second.join(0.01)
        finish()
        second.join(DEADLINE_S)
    [warning] = caught
    assert warning.category is RuntimeWarning
    assert "two threads step" in str(warning.message)
    assert "/tests/" in warning.filename
    env.step_async(ACTIONS)
    assert refused == []
    step_elsewhere().join(DEADLINE_S)
    assert refused == [AlreadyPendingCallError]
    assert env.step_wait()[0].shape == (2, 4)


@over_both_lanes
@pytest.mark.parametrize("asks", ["recv", "send", "reset"])
def test_a_second_thread_waits_to_send(
    env: Any, monkeypatch: pytest.MonkeyPatch, asks: str
) -> None:
    """It finds no half of it, which would look like one that a Ctrl-C has left."""
    requests, stopped, go_on = inside.session(env).requests, threading.Event(), threading.Event()
    submit, found = requests.submit_step, list[Any]()

    def slow(actions: Any) -> None:
        submit(actions)
        stopped.set()
        assert go_on.wait(DEADLINE_S)

    def ask() -> None:
        try:
            found.append(getattr(env, asks)(*[ACTIONS] * (asks == "send")))
        except Exception as error:
            found.append(error)

    monkeypatch.setattr(requests, "submit_step", slow)
    first, second = threading.Thread(target=lambda: env.send(ACTIONS)), threading.Thread(target=ask)
    first.start()
    assert stopped.wait(DEADLINE_S)
    second.start()
    second.join(0.2)  # as far as it comes
    monkeypatch.undo()
    go_on.set()
    first.join(DEADLINE_S)
    second.join(DEADLINE_S)
    assert len(found) == 1
    assert not isinstance(found[0], Exception), found
    if asks != "reset":
        received = env.recv() if asks == "send" else found[0]
        assert received.env_ids.tolist() == [0, 1]
