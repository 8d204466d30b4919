"""``Timeouts(idle_s)``: what nobody uses gives its memory back, and comes back with a reset."""

from __future__ import annotations

import time
from typing import Any

import psutil
import pytest

from envhub_sandbox import errors, make_env
from envhub_worker.protocol.lifecycle import State
from tests.faults.test_transparent import ALL_LIVE, SEED, SLOW, oracle
from tests.support.inside import pids, state
from tests.support.processes import eventually
from tests.support.samples import sample

IDLE_S = 0.5

pytestmark = pytest.mark.usefixtures("neighbour")
lanes = pytest.mark.parametrize("lane", ["auto", "frames"])
policies = pytest.mark.parametrize("restart", ["never", "transparent"])


def made(
    lane: str = "auto", restart: str = "never", idle_s: float | None = IDLE_S, shards: int = 2
) -> Any:
    """Four sub-environments in two processes, which do not live long without work."""
    return make_env(
        sample("mortal"),
        n_envs=4,
        use_async_envs=True,
        num_workers=shards,
        lane=lane,
        timeouts={"idle_s": idle_s},
        policy={"restart": restart, "restart_budget": 0},
    )


def ended(runners: list[int]) -> bool:
    """Whether all of these processes have gone, sooner or later."""
    return eventually(lambda: not any(map(psutil.pid_exists, runners)))


@lanes
@policies
def test_idle_processes_end_and_a_reset_starts_others(lane: str, restart: str) -> None:
    """It is no death: no policy and no budget is asked, and the same seeds give the same."""
    with made(lane, restart) as suites:
        env = suites.env
        env.reset(seed=SEED)
        env.step(ALL_LIVE)
        assert ended(pids(env))
        observation, info = env.reset(seed=SEED)
        assert observation.tolist() == oracle().reset(seed=SEED)[0].tolist()
        assert "worker_restarted" not in info
        assert env.step(ALL_LIVE)[0][:, 1].tolist() == [1, 1, 1, 1]
        assert env.stats()["deaths"] == env.stats()["restarts"] == 0


@lanes
@policies
def test_a_step_after_that_says_that_a_reset_is_needed(lane: str, restart: str) -> None:
    """Its episodes have gone with it; so it is, until there was a reset."""
    with made(lane, restart) as suites:
        env = suites.env
        env.reset()
        assert ended(pids(env))
        for ask in (lambda: env.step(ALL_LIVE), lambda: env.call("hello")):
            with pytest.raises(errors.WorkerDiedError, match=r"idle.*reset\(\)") as caught:
                ask()
            assert caught.value.reason == "idle"
            assert state(env) is State.EXPIRED
        env.reset()
        assert state(env) is State.READY


@lanes
def test_who_works_is_not_idle(lane: str) -> None:
    """Steps count, by whichever way they go, and so does one that takes longer than that."""
    idle_s = 2.0  # long beside a pause that a loaded machine makes between two steps
    with made(lane, idle_s=idle_s) as suites:
        env = suites.env
        env.reset()
        runners = pids(env)
        until = time.monotonic() + 2 * idle_s + 1.5  # the server looks once a second
        while time.monotonic() < until:
            env.step(ALL_LIVE)
            time.sleep(0.05)
        assert pids(env) == runners


@lanes
def test_a_long_step_is_not_idleness(lane: str) -> None:
    """Whoever owes an answer is busy, even asleep."""
    with made(lane, shards=1) as suites:
        env = suites.env
        env.reset()
        assert env.step([SLOW] * 4)[0][:, 1].tolist() == [1, 1, 1, 1]
        assert env.call("rest", 0.5) == (None,) * 4


def test_without_it_nothing_ends() -> None:
    """The default leaves everybody alone."""
    with made(idle_s=None) as suites:
        env = suites.env
        env.reset()
        runners = pids(env)
        time.sleep(2.0)
        assert pids(env) == runners


def test_other_tasks_go_on() -> None:
    """Each task of a suite has processes of its own, and a clock of its own."""
    timeouts = {"idle_s": 2.0}
    with make_env(sample("many_tasks"), timeouts=timeouts) as suites:
        first, second = list(next(iter(suites.values())).values())[:2]
        first.reset(), second.reset()
        idle = pids(first)
        while any(map(psutil.pid_exists, idle)):
            second.step(second.action_space.sample())
            time.sleep(0.02)
        assert state(second) is State.READY
        first.reset()
