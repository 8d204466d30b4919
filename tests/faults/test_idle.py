"""``Timeouts(idle_s)``: what nobody uses gives its memory back, and comes back with a reset."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import psutil
import pytest

from envhub_sandbox import errors, make_env
from envhub_worker.protocol.lifecycle import State
from tests.faults.mortal import ALL_LIVE, SEED, SLOW, comes_off, oracle
from tests.support.inside import pids, state
from tests.support.processes import eventually
from tests.support.samples import sample

IDLE_S = 0.5
WORKING_S = 2.0
pytestmark = pytest.mark.usefixtures("neighbour")
lanes = pytest.mark.parametrize("lane", ["auto", "frames"])
policies = pytest.mark.parametrize(
    ("lane", "restart"), [("auto", "transparent"), ("frames", "never")]
)


@contextmanager
def made(
    lane: str = "auto", restart: str = "never", idle_s: float | None = IDLE_S, shards: int = 2
) -> Iterator[Any]:
    """Four sub-environments in two processes, which do not live long without work."""
    with make_env(
        sample("mortal"),
        n_envs=4,
        use_async_envs=True,
        num_workers=shards,
        timeouts={"idle_s": idle_s},
        policy={"restart": restart, "restart_budget": 0, "lane": lane},
    ) as suites:
        yield suites.env


def ended(runners: list[int]) -> bool:
    """Whether all of these processes have gone, sooner or later."""
    return eventually(lambda: gone(runners))


def gone(runners: list[int]) -> bool:
    """Whether none of them is there any more. A jail whose server is asked about it is in use."""
    return not any(map(psutil.pid_exists, runners))


def played(env: Any) -> list[int]:
    """Its processes, after a reset and a step of the episode that began with it."""
    found: list[int] = []

    def play() -> None:
        env.reset(seed=SEED)
        assert env.step(ALL_LIVE)[0][:, 1].tolist() == [1, 1, 1, 1]
        found.extend(pids(env))

    assert eventually(lambda: comes_off(play))
    return found


def brought_back(env: Any) -> tuple[Any, Any]:
    """What a reset gives; one that is held up amid its requests is idle again, and begins anew."""
    found: list[tuple[Any, Any]] = []
    assert eventually(lambda: comes_off(lambda: found.append(env.reset(seed=SEED))))
    return found[0]


def works(env: Any, action: Any, enough: Callable[[], bool]) -> bool:
    """Step all the time, and be taken for busy; False if we were held up, which proves nothing."""
    brought_back(env)
    held_up, last, runners = 0.0, time.monotonic(), list[int]()
    if not comes_off(lambda: runners.extend(pids(env))):
        return False
    while not enough():
        alive = comes_off(lambda: env.step(action)) and all(map(psutil.pid_exists, runners))
        held_up, last = max(held_up, time.monotonic() - last), time.monotonic()
        if held_up > WORKING_S / 2:
            return False
        assert alive
        time.sleep(0.02)
    return True


@policies
def test_idle_processes_end_and_a_reset_starts_others(lane: str, restart: str) -> None:
    """It is no death: no policy and no budget is asked, and the same seeds give the same. A step
    before that says that a reset is needed."""
    with made(lane, restart) as env:
        assert ended(played(env))
        for ask in (lambda: env.step(ALL_LIVE), lambda: env.call("hello")):
            with pytest.raises(errors.WorkerDiedError, match=r"idle.*reset\(\)") as caught:
                ask()
            assert caught.value.reason == "idle"
            assert state(env) is State.EXPIRED
        observation, info = brought_back(env)
        assert observation.tolist() == oracle().reset(seed=SEED)[0].tolist()
        assert "worker_restarted" not in info
        assert state(env) is State.READY
        assert ended(played(env))
        brought_back(env)
        assert env.sandbox.stats()["deaths"] == env.sandbox.stats()["restarts"] == 0


@lanes
def test_who_works_is_not_idle(lane: str) -> None:
    with made(lane, idle_s=WORKING_S) as env:

        def works_on() -> bool:
            until = time.monotonic() + 3 * WORKING_S  # the server looks once a second
            return works(env, ALL_LIVE, lambda: time.monotonic() > until)

        assert eventually(works_on, 200)


@lanes
def test_a_long_step_is_not_idleness(lane: str) -> None:
    with made(lane, shards=1) as env:

        def play() -> None:
            env.reset()
            assert env.step([SLOW] * 4)[0][:, 1].tolist() == [1, 1, 1, 1]
            assert env.call("rest", 0.5) == (None,) * 4

        # nobody is held up between the requests of every attempt
        assert any(comes_off(play) for _ in range(10))


def test_without_it_nothing_ends() -> None:
    with made(idle_s=None) as env:
        env.reset()
        runners = pids(env)
        time.sleep(2.0)
        assert pids(env) == runners


def test_other_tasks_go_on() -> None:
    with make_env(sample("many_tasks"), timeouts={"idle_s": WORKING_S}) as suites:
        first, second = list(next(iter(suites.values())).values())[:2]
        action = second.action_space.sample()

        def goes_on() -> bool:
            idle = list[int]()
            if not comes_off(lambda: (first.reset(), idle.extend(pids(first)))):
                return False
            return works(second, action, lambda: gone(idle))

        assert eventually(goes_on, 200)
        assert state(second) is State.READY
        brought_back(first)


@lanes
def test_tasks_that_share_a_jail_come_back_one_by_one(lane: str) -> None:
    """Also one that was never used, one that asks after another has come back, and again later."""
    kwargs = {"form": "built"}
    timeouts, policy = {"idle_s": IDLE_S}, {"lane": lane}
    with make_env(
        sample("mortal"), n_envs=4, env_kwargs=kwargs, timeouts=timeouts, policy=policy
    ) as suites:
        first, second = suites["suite"].values()
        for _ in range(2):
            assert ended(played(first))
            brought_back(second)
            with pytest.raises(errors.WorkerDiedError, match=r"idle.*reset\(\)"):
                first.step(ALL_LIVE)
            assert ended(played(first) + played(second))
            brought_back(first)
            observation, _ = brought_back(second)
            assert observation.tolist() == oracle().reset(seed=SEED)[0].tolist()
        assert ended(played(first))
        brought_back(first)
        second.close()
        first.close()
