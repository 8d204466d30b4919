"""Processes and next tasks that start before anybody asks: bounded, given up, never felt."""

import concurrent.futures
import contextlib
import gc
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError

from envhub_sandbox import make_env
from envhub_sandbox.errors import RemoteEnvError, WorkerDiedError, WorkerError
from envhub_sandbox.sandboxes.pool import stop_idle
from envhub_sandbox.sandboxes.process import PROCESS
from envhub_sandbox.session.lease import Lease
from envhub_sandbox.system.folders import cache_root
from envhub_sandbox.transport.deadline import Deadline
from tests.support import inside
from tests.support.processes import descendants, eventually
from tests.support.repositories import STILL, write_repository
from tests.support.samples import sample

# every task says when it was constructed; one fails, if it is told to
SUITE = """
import time

class Task(Still):
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self, task, fails, number):
        if task == fails and number:  # the first one is made to look at, for the manifest
            raise ValueError(f"task {task} cannot be made")
        self.task, self.made = task, time.monotonic()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.array([self.task, self.np_random.random()]), {"made": self.made}

    def step(self, action):
        reward = float(self.np_random.random())
        return np.array([self.task, reward]), reward, False, False, {}

def make_env(n_envs=1, use_async_envs=False, tasks=5, fails=-1, suites=1):
    vector = gym.vector.SyncVectorEnv
    return {
        f"suite{number}": {
            task: vector([lambda t=task, n=n: Task(t, fails, n) for n in range(n_envs)])
            for task in range(tasks)
        }
        for number in range(suites)
    }
"""
Tasks = list[Any]


@pytest.fixture(scope="module", autouse=True)
def _server() -> Iterator[None]:
    """One for all of these, beside which is seen what they leave; in the end it goes, too."""
    stop_idle()
    before = descendants()
    use = PROCESS.acquire(cache_root() / "snapshots")
    with make_env(sample("counter")) as suites:
        suites.env.reset()  # so that its zygote is up, also if the manifest is remembered
    yield
    use.release()
    # what is interrupted in its start gives the server back a moment later, and that lingers
    assert eventually(lambda: stop_idle() is None and descendants() <= before)


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    return write_repository(tmp_path / "repository", STILL + SUITE)


@pytest.fixture
def tasks(repository: Path) -> Iterator[Callable[..., Tasks]]:
    """Makes the environments of a suite; nothing of them is left at the end."""
    before = descendants()
    made = []

    def make(count: int = 5, **options: Any) -> Tasks:
        n_envs = options.pop("n_envs", 1)
        kwargs = {"tasks": count, **options.pop("env_kwargs", {})}
        with make_env(repository, n_envs, env_kwargs=kwargs):
            pass  # its manifest is remembered
        made.append(make_env(repository, n_envs, env_kwargs=kwargs, **options))
        return _of(made[-1])

    yield make
    for suites in made:
        suites.close()
    assert eventually(lambda: descendants() <= before)


def states(tasks: Tasks) -> list[str]:
    return [env.sandbox.stats()["state"] for env in tasks]


def ahead(tasks: Tasks) -> list[int]:
    """Which ones are up, and were never asked anything."""
    found = [env.sandbox.stats() for env in tasks]
    idle = {"state": "READY", "requests": 0, "steps": 0}
    return [index for index, one in enumerate(found) if {**one, **idle} == one]


def settled(tasks: Tasks, expected: list[int]) -> bool:
    """Whether it comes to that, and stays there for a while."""
    reached = eventually(lambda: ahead(tasks) == expected)
    time.sleep(0.3)
    return reached and ahead(tasks) == expected


@pytest.mark.parametrize("ahead_of_time", [True, False])
def test_the_next_task_is_up_and_built_before_anybody_asks(
    tasks: Callable[..., Tasks], ahead_of_time: bool
) -> None:
    """Of the same suite. The control: without it each is made when it is asked."""
    first, second, *others = envs = tasks(
        2, policy={"prewarm": int(ahead_of_time)}, env_kwargs={"suites": 2}
    )
    first.reset()
    assert settled(envs, [1] if ahead_of_time else [])
    started, asked = descendants(), time.monotonic()
    _, infos = second.reset()
    assert (infos["made"][0] < asked) == ahead_of_time
    assert (descendants() <= started) == ahead_of_time
    assert settled(others, []), "another suite's are not started"


@pytest.mark.parametrize("closes", [False, True])
def test_by_default_who_closes_each_task_finds_the_next_one_up(
    tasks: Callable[..., Tasks], closes: bool
) -> None:
    """From the second on, and at most one; who uses one task, or all at once, pays nothing."""
    envs = tasks(5)
    envs[0].reset()
    assert settled(envs, [])
    for index in range(1, 4):
        if closes:
            envs[index - 1].close()
        envs[index].reset()
        assert settled(envs, [index + 1] if closes else [])


@pytest.mark.parametrize(("count", "warns"), [(1, False), (3, False), (3, True)])
def test_no_more_are_up_unused_than_was_said(
    tasks: Callable[..., Tasks], monkeypatch: pytest.MonkeyPatch, count: int, warns: bool
) -> None:
    """Whichever task is used next; what is not among the following is given up, and can return.
    So can what warns as it is closed, where a filter makes errors of warnings."""
    envs = tasks(8, policy={"prewarm": count})
    if warns:
        closing = Mock(side_effect=RuntimeWarning)
        monkeypatch.setattr(Lease, "close_politely", closing)
    used: set[int] = set()
    for index in (0, 4, 1):
        assert envs[index].reset()[0][0][0] == index
        used.add(index)
        following = [at for at in range(index + 1, 8) if at not in used]
        assert settled(envs, following[:count]), (index, states(envs))
    assert set(states(envs)) == {"READY", "IDLE"}
    monkeypatch.undo()


def test_one_task_outlives_the_suite_that_it_came_from(repository: Path) -> None:
    """Whoever takes one, and lets the others go, can use it."""
    env = make_env(repository, env_kwargs={"tasks": 3})["suite0"][1]
    gc.collect()
    with contextlib.closing(env):
        assert env.reset()[0][0][0] == 1.0


def test_closing_what_is_being_given_up_leaves_no_server(tasks: Callable[..., Tasks]) -> None:
    """Whoever gives it up has its turn still, and nothing of it any more: neither waits."""
    envs = tasks(2)
    envs[0].reset()
    owner, name = inside.use_lock(envs[1])
    held, closed = threading.Event(), threading.Event()

    def give_up() -> None:
        with getattr(owner, name):
            held.set()
            closed.wait(60)

    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        last = pool.submit(give_up)
        assert held.wait(60)
        envs[1].close()
        closed.set()
        last.result()
    envs[0].close()  # that nothing is left, the fixture asks


@pytest.fixture
def gated(tmp_path: Path) -> tuple[Path, Path, dict[str, Any]]:
    """A repository whose task 1 is made once there is a file; the file; the policy to see it.
    Its manifest is remembered."""
    gate, opened = tmp_path / "gate", tmp_path / "gate" / "open"
    gate.mkdir()
    gate.chmod(0o755)
    held_up = f"        while task == 1 and not os.path.exists({str(opened)!r}):"
    suite = SUITE.replace(
        "        self.task, self.made", f"{held_up}\n            pass\n        self.task, self.made"
    )
    repository = write_repository(tmp_path / "repository", f"import os\n{STILL}{suite}")
    opened.touch()
    policy = {"readable": (str(gate),)}
    with make_env(repository, policy=policy):
        pass
    opened.unlink()
    return repository, opened, policy


@pytest.mark.parametrize("plays", [True, False])
def test_while_one_is_waited_for_the_next_is_started(
    gated: tuple[Path, Path, dict[str, Any]], plays: bool
) -> None:
    """Else, where starting takes longer than playing, nothing would be gained; or nothing is up."""
    repository, opened, policy = gated
    elsewhere = descendants()
    with make_env(repository, policy={**policy, "prewarm": 1}) as suites:
        envs = _of(suites)
        if plays:
            envs[0].reset()
            # two jails of two: the second one is at the gate
            assert eventually(lambda: len(descendants() - elsewhere) == 4)
        assert all(_begun_meanwhile(envs, opened))


def _of(suites: Any) -> Tasks:
    return [env for tasks in suites.values() for env in tasks.values()]


def _begun_meanwhile(envs: Tasks, opened: Path) -> tuple[bool, bool]:
    """Whether task 2 comes up, and task 1, at the gate until then, has not answered."""
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        asked = pool.submit(envs[1].reset)
        begun = eventually(lambda: ahead(envs) == [2])
        waited = not asked.done()
        opened.touch()
        assert asked.result()[0][0][0] == 1.0
    return begun, waited


def test_what_fails_is_raised_by_the_tasks_first_request(tasks: Callable[..., Tasks]) -> None:
    """Not by the task before, which goes on; and the one after it is unharmed."""
    bundles = set(_bundles())
    envs = tasks(3, n_envs=2, policy={"prewarm": 1}, env_kwargs={"fails": 1})
    envs[0].reset()
    for _ in range(50):
        envs[0].step(np.zeros(2, int))
    assert settled(envs, [])
    with pytest.raises(RemoteEnvError, match="task 1 cannot be made"):
        envs[1].reset()
    assert (envs[2].reset()[0][0][0], set(_bundles())) == (2.0, bundles)


def test_what_dies_unused_is_started_again(tasks: Callable[..., Tasks]) -> None:
    """Although the policy restarts nothing: without prewarming it would not have died."""
    server = descendants()
    envs = tasks(2, policy={"prewarm": 1})
    assert eventually(lambda: descendants() <= server)
    envs[0].reset()
    envs[0].close()
    assert eventually(lambda: ahead(envs) == [1])
    jail = descendants() - server
    assert jail
    for pid in jail:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    [lease] = inside.leases(envs[1])

    def is_known() -> bool:
        with contextlib.suppress(WorkerDiedError):
            lease.look("reset", Deadline(60))
            return False
        return True

    assert eventually(is_known)  # a process may end a moment before the server hears of it
    assert envs[1].reset()[0][0][0] == 1.0


def test_closed_in_the_midst_it_leaves_nothing(repository: Path) -> None:
    """Whenever that comes: no process, and no bundle of a crash that was none. So does a suite that
    nobody holds."""
    before, bundles = descendants(), set(_bundles())
    for pause_s in (0.0, 0.05, 0.2):
        suites = make_env(repository, policy={"prewarm": 2}, timeouts={"server_idle_s": 0})
        envs = _of(suites)
        envs[0].reset()
        time.sleep(pause_s)
        suites.close()
        assert states(envs) == ["CLOSED"] * 5
        with pytest.raises(ClosedEnvironmentError):
            envs[0].prewarm()
    assert eventually(lambda: descendants() <= before)
    suites = make_env(repository, policy={"prewarm": 1}, timeouts={"server_idle_s": 0})
    envs = _of(suites)
    envs[0].reset()
    assert eventually(lambda: ahead(envs) == [1])
    envs.clear()
    del suites
    assert eventually(lambda: descendants() <= before)
    assert set(_bundles()) == bundles


def test_the_last_close_waits_for_all(tasks: Callable[..., Tasks]) -> None:
    """The others do not, and that is not left to chance: nothing of a jail is there after it."""
    elsewhere = descendants()
    envs = tasks(4, policy={"prewarm": 0})
    server = descendants()
    for env in envs[:3]:
        env.reset()
    for env in envs:
        env.close()
    assert descendants() - elsewhere <= server - elsewhere


def played(env: Any) -> list[Any]:
    first = env.reset(seed=7)[0].tolist()
    return [first, *([part.tolist() for part in env.step([1])[:4]] for _ in range(5))]


def test_threads_may_play_tasks_at_once(tasks: Callable[..., Tasks]) -> None:
    """A pool of threads, as ``max_parallel_tasks`` has; closed from the main one."""
    envs = tasks(8, policy={"prewarm": 2})
    with concurrent.futures.ThreadPoolExecutor(3) as pool:
        futures = {pool.submit(played, env): index for index, env in enumerate(envs)}
        for future in concurrent.futures.as_completed(futures):
            index = futures[future]
            assert future.result()[0][0][0] == index
            envs[index].close()
    assert states(envs) == ["CLOSED"] * 8


def _bundles() -> list[Path]:
    folder = cache_root() / "crashes"
    return list(folder.iterdir()) if folder.is_dir() else []


def test_one_environment_can_be_started_ahead() -> None:
    """One start, before any request; to prewarm what is warm does nothing. A reset in its midst
    waits for it, and what fails is raised by the first request."""
    options: dict[str, Any] = {"cfg": sample("counter"), "n_envs": 2}
    make_env(**options).close()  # its manifest is remembered: making it again starts nothing
    with make_env(**options) as suites:
        env = suites.env
        assert env.sandbox.stats()["state"] == "IDLE"
        env.prewarm(), env.prewarm()
        assert eventually(lambda: env.sandbox.stats()["state"] == "READY")
        started = descendants()
        env.prewarm()
        env.reset(seed=0)
        assert descendants() <= started  # what others left to linger may end meanwhile
        assert env.sandbox.stats()["requests"] == 1
    with make_env(**options) as suites:
        suites.env.prewarm()
        assert len(suites.env.reset(seed=0)[0]) == 2
        assert suites.env.sandbox.stats()["state"] == "READY"
    with make_env(**options, timeouts={"startup_s": 0.001}) as suites:
        suites.env.prewarm()
        with pytest.raises(WorkerError):
            suites.env.reset(seed=0)
        assert suites.env.sandbox.stats()["state"] == "IDLE"
