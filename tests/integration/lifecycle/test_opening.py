"""What is asked of a server, and what it has started, until an environment of a known pin is up."""

import os
import resource
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import psutil
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.sandboxes.pool import stop_idle
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.jail import JailHandle
from envhub_worker.protocol import messages as m
from tests.support import inside
from tests.support.repositories import STILL, write_repository
from tests.support.samples import sample


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The requests of this process, by name."""
    names: list[str] = []
    send = WorkerConnection.send

    def noted(self: WorkerConnection, message: Any, payload: Any = ()) -> int:
        names.append(type(message).__name__)
        return send(self, message, payload)

    monkeypatch.setattr(WorkerConnection, "send", noted)
    return names


@pytest.mark.parametrize("shards", [1, 3])
def test_all_shards_start_and_load_side_by_side(asked: list[str], shards: int) -> None:
    """However many there are, it is as many requests: to open, load, build, share slabs,
    attach, reset and call."""
    options: dict[str, Any] = {"n_envs": 3, "use_async_envs": True, "num_workers": shards}
    with make_env(sample("counter"), **options):
        pass  # its manifest is remembered
    asked.clear()
    with make_env(sample("counter"), policy={"lane": "frames"}, **options) as suites:
        suites.env.reset(seed=0)
        assert len(suites.env.call("get_wrapper_attr", "spec")) == 3
        asked_until_now = Counter(asked)
    assert asked_until_now == {"Hello": 1, "OpenJail": 1, "ShareSlabs": 1, "Relay": 5}


def test_many_descriptors_are_no_obstacle(tmp_path: Path) -> None:
    """Of a caller, where select() knows no more of them; and a server has all that it may have."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    folder = write_repository(tmp_path, STILL)
    stop_idle()  # a server of our own
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 4096), hard))
    files = [os.open(os.devnull, os.O_RDONLY) for _ in range(1100)]
    try:
        with make_env(folder) as suites:
            suites.env.reset()
            may_have = psutil.Process(inside.server(suites.env).process.pid).rlimit(
                psutil.RLIMIT_NOFILE
            )
            assert may_have == (min(hard, 65_536), hard)
    finally:
        for file in files:
            os.close(file)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_request_in_between_takes_no_descriptors(monkeypatch: pytest.MonkeyPatch) -> None:
    """They wait at the server for the ``Attach``, whatever else the runner is asked meanwhile."""
    whole, between = JailHandle.exchange, []

    def exchange(
        self: JailHandle,
        operation: str,
        requests: Sequence[tuple[int, Any]],
        deadline: Any,
        *,
        deposited: bool = False,
    ) -> list[m.Message]:
        if deposited:
            asked = [(runner, m.Watch(attach.env, "metadata")) for runner, attach in requests]
            between.append(whole(self, "call", asked, deadline))
        return whole(self, operation, requests, deadline, deposited=deposited)

    monkeypatch.setattr(JailHandle, "exchange", exchange)
    with make_env(sample("cartpole"), n_envs=2) as suites:
        env = suites.env
        env.reset(seed=1)
        env.step(env.action_space.sample())
        assert between
        assert inside.lane(env) is not None


REPOSITORY = """
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

class Counting(Still):
    def started(self):
        # the pid that the kernel gave out last, in the pid namespace of who reads it
        return int(open("/proc/loadavg").read().split()[-1])

def make_env(n_envs, use_async_envs, context, tasks, looks_into_them=False):
    def task():
        if not use_async_envs:
            return SyncVectorEnv([Counting] * n_envs)
        return AsyncVectorEnv([Counting] * n_envs, context=context)

    if looks_into_them:
        for env in [task() for _ in range(tasks)]:
            env.single_action_space
            env.close()
    return {"suite": {task_id: task() for task_id in range(tasks)}}
"""


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A suite whose sub-environments tell how many pids have been used around them."""
    return write_repository(tmp_path / "counting", STILL + REPOSITORY)


def started(repository: Path, use_async_envs: bool, **env_kwargs: object) -> int:
    """The processes and threads that the first task's jail has ever had, after its reset."""
    with make_env(repository, 2, use_async_envs, num_workers=1, env_kwargs=env_kwargs) as suites:
        env = suites["suite"][0]
        env.reset(seed=0)
        return int(env.call("started")[0])


def test_a_jail_starts_no_unasked_process(repository: Path) -> None:
    """However many tasks there are, and however the repository wanted its processes started.
    The control: two processes for each of ten tasks, all of which have ended, are counted."""
    plain = started(repository, use_async_envs=False, context=None, tasks=1)
    for context, tasks in (("fork", 1), ("spawn", 10)):
        assert started(repository, use_async_envs=True, context=context, tasks=tasks) == plain
    arguments = {"context": "fork", "tasks": 10, "looks_into_them": True}
    assert started(repository, use_async_envs=True, **arguments) >= plain + 20
