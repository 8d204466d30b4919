"""``restart="transparent"``: what died comes back reset and says so; the others go on."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from gymnasium.error import ClosedEnvironmentError

from envhub_sandbox import errors, make_env
from envhub_sandbox.extras.restart.recovery import derived_seed
from envhub_worker.protocol.lifecycle import State
from tests.faults.endurance.monkey import same
from tests.faults.mortal import ALL_LIVE, CRASH, EXIT, KILL, LIVE, MEMORY, RAISE, SEED, SPIN, oracle
from tests.support import inside
from tests.support.processes import eventually, halted
from tests.support.repositories import write_repository
from tests.support.samples import reference, sample

POLICY = {"restart": "transparent", "restart_backoff_s": 0, "crash_history": 0}
LAST_DIES = [LIVE, LIVE, LIVE, EXIT]
DEAD, ALL = slice(2, 4), slice(4)
pytestmark = pytest.mark.usefixtures("neighbour")


def made(
    lane: str = "auto",
    shards: int = 2,
    env_kwargs: dict[str, Any] | None = None,
    folder: Path | None = None,
    **more: Any,
) -> Any:
    """Four sub-environments in two processes, of which the second holds the last two."""
    policy = POLICY | {"lane": lane} | more.pop("policy", {})
    options = {"num_workers": shards, "policy": policy, "env_kwargs": env_kwargs or {}, **more}
    return make_env(folder or sample("mortal"), n_envs=4, use_async_envs=True, **options)


def fresh(restart: int, rows: slice = DEAD) -> Any:
    """What sub-environments seeded with SEED observe when they come back."""
    seeds = [derived_seed(SEED + row, restart) for row in range(4)[rows]]
    alone = reference("mortal", n_envs=len(seeds))
    return alone.reset(seed=seeds)[0]


def restarted(info: dict[str, Any], rows: slice = DEAD) -> bool:
    expected = np.isin(range(4), range(4)[rows])
    both = info["worker_restarted"], info["_worker_restarted"]
    return all(np.array_equal(one, expected) for one in both)


def came_back(result: Any, counts: list[int] | None = None, rows: slice = DEAD) -> None:
    """Of a step: these rows, and no other, are truncated and marked; what has been counted."""
    observation, _, _, truncated, info = result
    assert truncated.tolist() == np.isin(range(4), range(4)[rows]).tolist()
    assert restarted(info, rows)
    assert counts is None or observation[:, 1].tolist() == counts


def goes_on(env: Any, counts: tuple[int, ...] = (1, 1, 1, 1)) -> None:
    assert env.step(ALL_LIVE)[0][:, 1].tolist() == list(counts)


def dies(env: Any, number: int = 1) -> None:
    """One of its processes, from outside."""
    os.kill(inside.pids(env)[number], signal.SIGKILL)


@contextmanager
def begun(lane: str = "auto", **options: Any) -> Iterator[Any]:
    with made(lane, **options) as suites:
        suites.env.reset(seed=SEED)
        yield suites.env


@pytest.fixture
def env(request: pytest.FixtureRequest) -> Iterator[Any]:
    """The same, over either lane."""
    with begun(getattr(request, "param", "auto")) as found:
        yield found


both = pytest.mark.parametrize("env", ["auto", "frames"], indirect=True)
lanes = pytest.mark.parametrize("lane", ["auto", "frames"])


@both
@pytest.mark.parametrize("how", [EXIT, KILL, CRASH])
def test_the_dead_come_back_and_the_others_go_on(env: Any, how: int) -> None:
    """The rows of the dead are fresh and truncated, all others are what they would have been."""
    beside = oracle()
    beside.reset(seed=SEED)
    assert same(env.step(ALL_LIVE), beside.step(ALL_LIVE))
    got, expected = env.step([LIVE, LIVE, how, LIVE]), beside.step(ALL_LIVE)
    for mine, other in zip(got[:4], expected[:4], strict=True):
        assert np.array_equal(mine[:2], other[:2])
    came_back(got)
    assert np.array_equal(got[0][DEAD], fresh(1))
    assert (got[1][DEAD].tolist(), got[2].any()) == ([0, 0], False)
    assert got[4]["at"].tolist() == [2, 2, 0, 0]
    assert inside.state(env) is State.READY
    assert env.sandbox.stats()["deaths"] == env.sandbox.stats()["restarts"] == 1


@both
def test_next_step_resets_what_came_back_truncated(env: Any) -> None:
    """As after any truncation in this mode: the action after it resets, the next one counts."""
    beside = oracle()
    env.step(LAST_DIES)
    beside.reset(seed=[0, 0, *[derived_seed(SEED + row, 1) for row in (2, 3)]])
    beside._autoreset_envs[DEAD] = True
    for _ in range(7):
        mine, other = env.step(ALL_LIVE), beside.step(ALL_LIVE)
        for got, expected in zip(mine[:4], other[:4], strict=True):
            assert np.array_equal(got[DEAD], expected[DEAD])
        assert "worker_restarted" not in mine[4]


@lanes
def test_same_step_has_begun_the_next_episode(lane: str) -> None:
    """The fresh observation is the next episode's first, and stands for the lost final one."""
    with begun(lane, env_kwargs={"mode": "SameStep"}) as env:
        observation, _, _, truncated, info = env.step(LAST_DIES)
        assert truncated.tolist() == [False, False, True, True]
        assert info["_final_obs"].tolist() == info["_final_info"].tolist() == truncated.tolist()
        assert np.array_equal(np.stack(info["final_obs"][DEAD]), observation[DEAD])
        after = env.step(ALL_LIVE)[0]
        assert after[:, 1].tolist() == [2, 2, 1, 1]
        assert np.array_equal(after[DEAD, 0], observation[DEAD, 0])


def test_disabled_wants_a_reset_of_what_came_back() -> None:
    """A step is refused as after any episode's end, and a masked reset goes on with the others."""
    with begun(env_kwargs={"mode": "Disabled"}) as env:
        assert env.step(LAST_DIES)[3].tolist() == [False, False, True, True]
        with pytest.raises(errors.RemoteEnvError):
            env.step(ALL_LIVE)
        env.reset(options={"reset_mask": np.array([False, False, True, True])})
        assert env.step(ALL_LIVE)[0][DEAD, 1].tolist() == [1, 1]


@lanes
def test_the_only_process_comes_back_whole(lane: str) -> None:
    """Also with observations that are lent, which stay as they were."""
    with begun(lane, shards=1, copy=False) as env:
        jail, held = inside.jail(env).number, [env.step(ALL_LIVE)[0]]
        for _ in range(2):
            got = env.step(LAST_DIES)
            came_back(got, rows=ALL)
            held.append(got[0])
            assert not got[1].any()
            assert not env.step(ALL_LIVE)[3].any()  # the reset after a truncation
        assert held[0][:, 1].tolist() == [1, 1, 1, 1]
        for restart in (1, 2):
            assert np.array_equal(held[restart], fresh(restart, ALL))
        assert inside.jail(env).number == jail


def test_chance_after_a_death_is_as_before() -> None:
    """Seeds after it derive from those before it; without one, no episode comes twice."""

    def run() -> list[Any]:
        with begun() as env:
            return [env.step(LAST_DIES if at % 3 == 1 else ALL_LIVE)[0] for at in range(9)]

    assert all(np.array_equal(a, b) for a, b in zip(run(), run(), strict=True))
    with made() as suites:
        suites.env.reset()
        assert len({suites.env.step(LAST_DIES)[0][3, 0] for _ in range(3)}) == 3


@lanes
def test_a_reset_is_done_again_in_the_fresh_process(lane: str) -> None:
    """Whoever dies in a reset is reset with the very seeds and options, once more."""
    with made(lane) as suites:
        env = suites.env
        observation, info = env.reset(seed=SEED, options={"exit_once": True})
        expected, _ = oracle().reset(seed=SEED)
        assert np.array_equal(observation, expected)
        assert restarted(info, slice(0, 2)) or restarted(info, DEAD)
        goes_on(env)


@lanes
@pytest.mark.parametrize("dies_in", ["step", "reset"])
def test_infos_that_differ_in_kind_survive_a_death(tmp_path: Path, lane: str, dies_in: str) -> None:
    with made(lane, folder=write_repository(tmp_path / "mixed", _MIXED)) as suites:
        env = suites.env
        _, expected = env.reset()
        kept = [one.np_random for one in env.envs]  # which the client asks for after each request
        info = env.step(LAST_DIES)[4] if dies_in == "step" else env.reset(options={"exit": 1})[1]
        assert restarted(info)
        assert {key: info[key] for key in expected}.keys() == expected.keys() > {"k", "_k"}
        assert list(info["n"]) == [0, 1, 2, 3]
        assert repr({key: info[key] for key in expected}) == repr(expected)
        assert env.sandbox.stats()["state"] == "READY"
        assert repr(env.step(ALL_LIVE)[4]) == repr(expected)
        assert len(kept) == 4


_MIXED = """
import gymnasium as gym, numpy as np, os, tempfile

class Mixed(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(8)

    def __init__(self, index):
        self.index = index

    def told(self):
        return np.zeros(2, np.float32), {"k": {"a": 1} if self.index < 2 else None, "n": self.index}

    def reset(self, *, seed=None, options=None):
        mark = os.path.join(tempfile.gettempdir(), "died")
        if options and "exit" in options and self.index == 2 and not os.path.exists(mark):
            open(mark, "x").close()
            os._exit(3)
        return self.told()

    def step(self, action):
        if action == 1:
            os._exit(3)
        observation, info = self.told()
        return observation, 0.0, False, False, info

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.AsyncVectorEnv([lambda i=i: Mixed(i) for i in range(n_envs)])
"""


def test_a_masked_reset_brings_back_whom_it_does_not_name(env: Any) -> None:
    """A shard that dies in it has lost all its rows: the others start again, and are marked."""
    env.step(ALL_LIVE)
    mask = np.array([False, False, True, False])
    seeds = [None, None, 99, None]
    options = {"reset_mask": mask, "exit_once": True}
    observation, info = env.reset(seed=seeds, options=options)
    assert restarted(info)
    assert observation[:, 1].tolist()[2:] == [0, 0]
    assert np.array_equal(observation[2], reference("mortal").reset(seed=99)[0][0])
    assert np.array_equal(observation[3], fresh(1)[1])
    goes_on(env, (2, 2, 1, 1))


def test_who_dies_again_in_coming_back_is_dead() -> None:
    """There is one attempt; afterwards it is dead as without it, and a reset starts afresh."""
    with made() as suites:
        env = suites.env
        with pytest.raises(errors.WorkerDiedError) as caught:
            env.reset(options={"exit": True})
        assert caught.value.exit_code == 4
        assert inside.state(env) is State.DEAD
        with pytest.raises(errors.WorkerDiedError, match="cannot step"):
            env.step(ALL_LIVE)
        env.reset(seed=SEED)
        goes_on(env)


def test_a_call_is_not_repeated(env: Any) -> None:
    """It says how they died; the next step brings them back, and the others have not moved."""
    env.step(ALL_LIVE)
    for _ in range(2):
        with pytest.raises(errors.WorkerDiedError) as caught:
            env.call("last_words")
        assert caught.value.exit_code == 5
        assert caught.value.request == "call"
        assert inside.state(env) is State.READY
    came_back(env.step(ALL_LIVE), [0, 0, 0, 0], ALL)
    assert env.call("hello") == ("hello",) * 4


def test_what_was_set_is_set_again(env: Any, caplog: pytest.LogCaptureFixture) -> None:
    """In the fresh process, before anything else is asked of it: the last value of each, as it was
    sent, of all or of one. What cannot be set is left out; that is logged, and so is the death."""
    env.set_attr("weight", 1)
    env.set_attr("colour", ["red", "green", "blue", "white"])
    env.set_attr("weight", [5, 6, 7, 8])
    goals: dict[str, Any] = {"goal": np.zeros(2)}
    env.set_attr("goals", [goals] * 4)
    goals["goal"][:] = 9
    goals["lock"] = threading.Lock()
    env.set_attr("drawn_so_far", 0.5)
    with pytest.raises(errors.RemoteEnvError):
        env.set_attr("fixed", 3)
    with caplog.at_level("INFO", "envhub_sandbox.worker"):
        came_back(env.step(LAST_DIES))
    [told] = [one for one in caplog.messages if "start again" in one]
    assert "the worker process died during step: it exited (exit code" in told
    assert "sub-environments [2, 3]" in told
    assert "'drawn_so_far' could not be set again" in caplog.text
    assert env.get_attr("weight") == (5, 6, 7, 8)
    assert env.get_attr("colour") == ("red", "green", "blue", "white")
    assert [one["goal"].tolist() for one in env.get_attr("goals")] == [[0, 0]] * 4
    dies(env)
    env.reset(seed=SEED)
    assert env.get_attr("weight") == (5, 6, 7, 8), "a reset that brings it back"
    env.call("__setattr__", "weight", 5)
    env.envs[3].weight = 6
    env.envs[2].set_wrapper_attr("colour", "red")
    env.envs[3].colour = "blue"
    env.call("__setattr__", "colour", "green")
    came_back(env.step(LAST_DIES))
    assert env.get_attr("weight") == (5, 5, 5, 6), "of one"
    assert env.get_attr("colour") == ("green",) * 4, "whichever came last"


def test_a_fresh_jail_has_no_attributes_of_the_last() -> None:
    with begun(timeouts={"step_s": 0.05}) as env:
        env.set_attr("weight", 7)
        with pytest.raises(errors.WorkerTimeoutError):
            env.step([SPIN, LIVE, LIVE, LIVE])
        for also_dies in (True, False):
            env.reset(seed=SEED)
            with pytest.raises(errors.RemoteEnvError):
                env.get_attr("weight")
            if also_dies:
                dies(env)


@both
def test_a_death_between_requests_is_met_by_the_next(env: Any) -> None:
    """Killed from outside while nothing is asked: a call says so; a step, or a reset, brings it
    back."""
    victim = inside.pids(env)[1]
    dies(env)
    assert eventually(lambda: not psutil.pid_exists(victim))
    with pytest.raises(errors.WorkerDiedError, match="SIGKILL"):
        env.get_attr("steps")
    came_back(env.step(ALL_LIVE), [1, 1, 0, 0])
    dies(env)
    observation, info = env.reset(seed=SEED)
    assert np.array_equal(observation, oracle().reset(seed=SEED)[0])
    assert restarted(info)


@both
def test_the_end_of_the_jail_takes_all_rows(env: Any) -> None:
    jail, runners = inside.jail(env).number, inside.pids(env)
    psutil.Process(runners[0]).parent().kill()
    assert eventually(lambda: not any(map(psutil.pid_exists, runners)))
    got = env.step(ALL_LIVE)
    came_back(got, rows=ALL)
    assert np.array_equal(got[0], fresh(1, ALL))
    assert inside.jail(env).number != jail


@lanes
def test_memory_of_all_takes_all_rows(lane: str) -> None:
    """The limit is the jail's: where it cannot be told who has broken it, all shards come back.
    That of processor time is a process's."""
    with begun(lane, policy={"limits": {"memory_bytes": 400 << 20, "cpu_time_s": 2}}) as env:
        _, _, _, truncated, info = env.step([LIVE, LIVE, LIVE, MEMORY])
        assert truncated[DEAD].all()
        assert info["worker_restarted"][DEAD].all()
        assert np.array_equal(truncated, info["worker_restarted"])
        env.step(ALL_LIVE)  # it meets those who had answered before their end came
        assert not env.step(ALL_LIVE)[3].any()
        if lane == "auto":
            env.reset(seed=SEED)
            env.step(ALL_LIVE)
            came_back(env.step([LIVE, LIVE, LIVE, SPIN]), [2, 2, 0, 0])


@both
def test_what_else_happens_beside_a_death_is_told_first(env: Any) -> None:
    """An error of a sibling's, after which the next step tells of the death; or that it is late."""
    with pytest.raises(errors.RemoteEnvError, match="as told"):
        env.step([LIVE, RAISE, LIVE, EXIT])
    assert inside.state(env) is State.READY
    assert restarted(env.step(ALL_LIVE)[4])
    env.step(ALL_LIVE)
    with halted(inside.pids(env)[:1]):
        env.step_async([LIVE, LIVE, LIVE, EXIT])
        with pytest.raises(errors.WorkerTimeoutError):
            env.step_wait(timeout=0.1)
    assert inside.state(env) is State.LATE
    observation, _ = env.reset(seed=SEED)
    assert np.array_equal(observation, oracle().reset(seed=SEED)[0])
    goes_on(env)


def test_budget_ends_in_the_death_itself() -> None:
    """When all restarts are used up a death is told as it is, with the reason for staying dead."""
    with made(policy={"restart_budget": 1}) as suites:
        env = suites.env
        env.reset()
        env.step(LAST_DIES)
        env.step(ALL_LIVE)
        with pytest.raises(errors.WorkerDiedError, match="died during step") as caught:
            env.step(LAST_DIES)
        assert caught.value.exit_code == 3
        assert "all 1 restarts" in str(caught.value.__cause__)
        assert inside.state(env) is State.DEAD
        with pytest.raises(errors.WorkerDiedError, match="all 1 restarts"):
            env.reset()


def test_an_environment_with_a_step_of_its_own_comes_back_whole() -> None:
    with begun(shards=1, env_kwargs={"form": "whole"}) as env:
        got = env.step(LAST_DIES)
        came_back(got, [0, 0, 0, 0], ALL)
        assert not got[1].any()
        goes_on(env)


def test_environments_of_one_jail_come_back_each_on_its_own() -> None:
    """They share a process: its death is everybody's, and each is told at its own next step."""
    with made(env_kwargs={"form": "built"}) as suites:
        first, second = suites["suite"]["a"], suites["suite"]["b"]
        for env in (first, second):
            env.reset(seed=SEED)
        for got in first.step(LAST_DIES), second.step(ALL_LIVE):
            came_back(got, rows=ALL)
        assert not first.step(ALL_LIVE)[3].any()


def test_close_does_not_wait_for_who_is_coming_back() -> None:
    with begun(env_kwargs={"form": "slow"}, shards=1) as env:
        closing = threading.Timer(0.3, env.close)
        closing.start()
        with pytest.raises(ClosedEnvironmentError):
            env.step(LAST_DIES)
        closing.join()
        assert inside.state(env) is State.CLOSED


def test_coming_back_has_a_deadline() -> None:
    """A fresh process that does not load in time is a timeout; a reset starts afresh."""
    with begun(env_kwargs={"form": "slow"}, shards=1) as env:
        with (
            inside.hurried(env, startup_s=2.0),
            pytest.raises(errors.WorkerTimeoutError, match="make_env"),
        ):
            env.step(LAST_DIES)
        assert inside.state(env) is State.LATE
        assert np.array_equal(env.reset(seed=SEED)[0], oracle().reset(seed=SEED)[0])


def test_interrupted_in_coming_back_it_starts_afresh(tmp_path: Path) -> None:
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    output, caller = tmp_path / "output", threading.get_ident()

    def interrupt() -> None:
        assert eventually(lambda: "slowly" in output.read_text())
        signal.pthread_kill(caller, signal.SIGALRM)

    try:
        policy = {"output": str(output)}
        with begun(env_kwargs={"form": "slow"}, shards=1, policy=policy) as env:
            coming = threading.Thread(target=interrupt)
            with pytest.raises(KeyboardInterrupt):
                coming.start(), env.step(LAST_DIES)
            coming.join()
            assert inside.state(env) is State.LATE
            env.reset(seed=SEED)
            goes_on(env)
    finally:
        signal.signal(signal.SIGALRM, before)


def test_the_dead_leave_nothing_in_their_jail() -> None:
    """After twenty deaths the jail has two processes, and the client no more descriptors."""
    with made() as suites:
        env = suites.env
        env.reset()
        env.step(LAST_DIES)
        held = len(os.listdir("/proc/self/fd"))
        for _ in range(20):
            env.step(LAST_DIES)
            env.step(ALL_LIVE)
        # what others left may be closed meanwhile, and what a thread has open just now
        assert eventually(lambda: len(os.listdir("/proc/self/fd")) <= held)
        init = psutil.Process(inside.pids(env)[0]).parent()
        assert eventually(lambda: len(init.children(recursive=True)) == 2)
