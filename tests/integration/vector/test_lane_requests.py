"""What a lane carries: requests, several steps at once, what is too large; nothing is mixed up."""

import os
import platform
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import RemoteEnvError, RemoteProtocolError
from envhub_sandbox.extras.remote.served_lane import ServedLane
from envhub_sandbox.extras.several_workers import worker_queue
from envhub_sandbox.transport.deadline import Deadline, SpinChooser, StepDeadline
from envhub_sandbox.transport.shared_memory import lane
from envhub_worker.protocol.limits import DEFAULT_LIMITS, limits_for
from envhub_worker.protocol.shared_memory import slabs
from tests.support import inside
from tests.support.compare import assert_same
from tests.support.in_process.interrupts import before_line
from tests.support.objects.pipelines import changing, one_by_one, several_at_once
from tests.support.processes import descendants
from tests.support.repositories import STILL, write_repository
from tests.support.started import started

REPOSITORY = '''
LARGE = 2 * 65536

class Talker(Still):
    """Counts what it is asked, says so in its infos, and some of these are large."""

    observation_space = gym.spaces.Box(0, 1e6, (2,), np.float32)
    action_space = gym.spaces.Discrete(4)

    def __init__(self):
        self.asked = 0
        self.small = "small"

    def seen(self):
        return np.full(2, self.asked, np.float32)

    def said(self, what, large):
        return {"what": (what, self.asked, "x" * (LARGE if large else 1))}

    def reset(self, *, seed=None, options=None):
        self.asked += 1
        return self.seen(), self.said("reset", (options or {}).get("large", False))

    def step(self, action):
        self.asked += 1
        if action == 2:
            raise ValueError("no")
        return self.seen(), 0.0, False, False, self.said("step", action == 1)

    def tell(self, large, ignored=None):
        self.asked += 1
        return self.said("call", large)["what"]

    def signal(self):
        import os

        os.kill(os.getpid(), 40)

def make_env(n_envs=1, use_async_envs=False):
    cls = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return cls([Talker] * n_envs)
'''
assert slabs.INFO_BYTES == 65536, "what is large has changed"


@pytest.fixture(scope="module")
def talker(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_repository(tmp_path_factory.mktemp("talker"), STILL + REPOSITORY)


def conversation(folder: Path, lane: str, num_workers: int) -> list[Any]:
    """Large and small answers of every kind, one after the other."""
    with make_env(
        folder, 4, use_async_envs=True, policy={"lane": lane}, num_workers=num_workers
    ) as suites:
        env = suites.env
        heard: list[Any] = []
        for large in (True, False, True):
            heard.append(env.reset(options={"large": large}))
            for action in (1, 0, 1, 1):
                heard += [env.step([action] * 4), env.call("tell", large), env.get_attr("small")]
                heard.append(env.step([1, 0, 0, 1]))
        return heard


@pytest.mark.parametrize("num_workers", [1, 2])
def test_large_and_small_answers_are_not_mixed_up(talker: Path, num_workers: int) -> None:
    """Whatever did not fit the lane is fetched for the request that it belongs to."""
    by_lane = conversation(talker, "auto", num_workers)
    assert_same(conversation(talker, "frames", num_workers), by_lane)


@pytest.mark.parametrize("lane", ["auto", "frames"])
def test_ctrl_c_in_a_large_answer_leaves_the_next_reset_its_own(talker: Path, lane: str) -> None:
    """What did not fit has been asked for by then: it is dropped with the answer, and the same
    process goes on."""
    with make_env(talker, 2, policy={"lane": lane}) as suites:
        env = suites.env
        asked, moment, came = 0, 0, True
        while came:
            env.send_reset(options={"large": True})
            came = before_line(worker_queue.__file__, moment, env.recv)
            asked += 2
            assert env.reset()[0].tolist() == [[asked] * 2] * 2, moment
            moment += 1
        assert moment > 5


@pytest.mark.parametrize(("lane", "restart"), [("auto", "on_reset"), ("frames", "transparent")])
def test_an_operation_has_one_deadline(
    talker: Path, lane: str, restart: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many shards have answers to be fetched: no fetch starts the clock anew.
    Or else runners that answer at the last moment would make a step last as long as they please."""
    made: list[float | None] = []
    initialize, running = Deadline.__init__, vars(StepDeadline)["running"]

    def counted(self: Deadline, timeout_s: float | None) -> None:
        made.append(timeout_s)
        initialize(self, timeout_s)

    def begin(self: StepDeadline, value: bool) -> None:
        made.extend([] if value else [self.timeout_s])
        running.__set__(self, value)

    timeouts = {"step_s": 1001.0, "reset_s": 1002.0, "call_s": 1003.0}
    options = {"num_workers": 4, "policy": {"restart": restart, "lane": lane}}
    with make_env(talker, 4, use_async_envs=True, timeouts=timeouts, **options) as suites:
        env = suites.env
        env.reset()
        monkeypatch.setattr(Deadline, "__init__", counted)
        monkeypatch.setattr(StepDeadline, "running", property(running.__get__, begin))
        for act, timeout_s in (
            (lambda: env.step([1, 1, 1, 1]), 1001.0),
            (lambda: env.reset(options={"large": True}), 1002.0),
            (lambda: env.call("tell", True), 1003.0),
        ):
            made.clear()
            act()
            assert [one for one in made if one in timeouts.values()] == [timeout_s]
        monkeypatch.undo()


@pytest.mark.parametrize("copy", [True, False])
def test_what_came_before_stays_as_it_was(talker: Path, copy: bool) -> None:
    """Where the options of a reset do not fit the lane, and it goes another way than what follows;
    and where a step has failed, after which a masked reset shows the last rows. A signal without a
    name is told, and others go on."""
    with make_env(talker, 2, copy=copy) as suites, make_env(talker) as others:
        env = suites.env
        held = [env.reset()[0], env.step([0, 0])[0]]
        before = [one.copy() for one in held]
        env.reset(options={"padding": "x" * 2 * slabs.INFO_BYTES})
        env.get_attr("small")
        held.append(env.step([0, 0])[0])
        with pytest.raises(RemoteEnvError, match="no"):
            env.step([2, 0])
        observation, _ = env.reset(options={"reset_mask": np.array([True, False])})
        assert observation[1].tolist() == [4, 4]
        np.testing.assert_array_equal(held[:2], before)
        others.env.reset()
        with pytest.raises(Exception, match="signal 40"):
            env.call("signal")
        others.env.step([0])


@pytest.mark.parametrize("lane", ["auto", "frames"])
@pytest.mark.parametrize(("count", "size"), [(2, 3), (1, 100_000)])
def test_what_comes_is_what_a_step_gives(tmp_path: Path, lane: str, count: int, size: int) -> None:
    """Also where infos do not fit, change their columns or are not there, and where one raises;
    back and forth between steps through slabs and steps as messages."""
    folder = changing(tmp_path, size)
    with started(folder, count, policy={"lane": "auto"}) as env:
        expected = one_by_one(env)
    took: list[bool] = []
    with started(folder, count, policy={"lane": lane}) as env:
        found = inside.session(env).lease.lane
        assert isinstance(found, ServedLane) == (lane == "frames")
        results = several_at_once(env, lambda: took.append(found.takes_more))
    assert set(took) == ({True, False} if lane == "frames" else {False})
    for number, (wanted, came) in enumerate(zip(expected, results, strict=True)):
        assert_same(wanted[0], came[0], f"step {number}")
    warned = [sorted(text for _, texts in some for text in texts) for some in (expected, results)]
    assert warned[0] == warned[1]
    assert len(warned[0]) > 10


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="this machine has a single core")
@pytest.mark.parametrize("space", ["Box(0, 1, (2,), np.float32)", "Text(4)"])
def test_a_single_runner_leaves_the_core_that_its_client_waits_on(
    tmp_path: Path, space: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would never run there while the client waits awake. While it sleeps, it may: the kernel
    wakes it fastest on that core."""
    monkeypatch.setattr(SpinChooser, "measured", lambda *_: None)
    monkeypatch.setattr(SpinChooser, "missed", lambda *_: None)
    every, action = os.sched_getaffinity(0), np.zeros(1, np.int64)
    folder = write_repository(tmp_path, STILL + _SPACE.replace("SPACE", space))
    with started(folder, 1) as env:
        for core in sorted(every)[:2]:
            try:
                os.sched_setaffinity(0, {core})
                for budget_ns in (0, 10**5, 0):
                    inside.wait_awake(env, budget_ns)
                    for _ in range(3):  # where steps are messages, the third is like the second
                        env.step(action)
                    seen = [os.sched_getaffinity(pid) for pid in inside.pids(env)]
                    assert (every - {core} in seen) == bool(budget_ns)
            finally:
                os.sched_setaffinity(0, every)


@pytest.mark.skipif(platform.machine() != "x86_64", reason="elsewhere nobody waits awake")
@pytest.mark.parametrize("shards", [2, 3])
def test_nobody_waits_awake_if_shards_outnumber_cores(
    tmp_path: Path, shards: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A shard that waits awake would take its core from those that share it."""
    begin, allowed = SpinChooser.__init__, list[bool]()
    monkeypatch.setattr(
        SpinChooser, "__init__", lambda self, may: (allowed.append(may), begin(self, may))[1]
    )
    monkeypatch.setattr(lane, "own_cpus", lambda: [0, 1])
    folder = write_repository(tmp_path, STILL + _SPACE.replace("SPACE", "Discrete(2)"))
    with started(folder, shards, use_async_envs=True, num_workers=shards):
        assert {*allowed} == {shards == 2}


_SPACE = """
class Shown(Still):
    observation_space = gym.spaces.SPACE

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}
"""

_ENV = """
class Large(Still):
    observation_space = gym.spaces.Box(0, 255, (SIZE,), np.uint8)

    def reset(self, *, seed=None, options=None):
        return np.zeros(SIZE, np.uint8), {}

    def step(self, action):
        return np.zeros(SIZE, np.uint8), 0.0, False, False, {"large": [np.zeros(3 << 20, np.uint8)]}

    def large(self, size):
        return np.zeros(size, np.uint8)
"""


def _repository(folder: Path, size: int) -> Path:
    return write_repository(folder, STILL + _ENV.replace("SIZE", str(size)))


@pytest.mark.parametrize("lane", ["auto", "frames"])
def test_limits_of_messages_are_the_jails_own(tmp_path: Path, lane: str) -> None:
    """What is larger is an error of that call, and the environment goes on. A larger one lets more
    through than the default, which the server's own reader has as well; of a space that is too
    large the limit is named."""
    folder, size = _repository(tmp_path / "small", 4), DEFAULT_LIMITS.message_bytes + 1
    with make_env(folder, policy={"lane": lane}, limits={"message_bytes": 1 << 20}) as suites:
        env = suites.env
        env.reset()
        with pytest.raises(RemoteEnvError, match=r"1048576 \(message_bytes\)"):
            env.call("large", 2 << 20)
        assert "RemoteObject" in repr(type(env.step(np.array([0]))[4]["large"][0][0]))
        assert len(env.call("large", 1 << 19)[0]) == 1 << 19
    if lane == "frames":
        return
    assert limits_for(2 * size) is limits_for(2 * size)
    with make_env(folder, limits={"message_bytes": 2 * size}) as suites:
        assert len(suites.env.call("large", size)[0]) == size
    folder = _repository(tmp_path / "large", 100 << 10)
    with pytest.raises(RemoteProtocolError, match=r"raise the limit.*elements"):
        make_env(folder, limits={"elements": 10_000}).close()
    make_env(folder, limits={"elements": 1_000_000}).close()


def test_a_runner_that_sleeps_is_woken_once_for_a_step(talker: Path) -> None:
    """With a process for each sub-environment, a second wake-up would be half of a step."""
    steps, workers = 12, 4
    with started(talker, workers, use_async_envs=True, num_workers=workers) as env:
        processes = [psutil.Process(pid) for pid in descendants()]
        before = sum(process.num_ctx_switches().voluntary for process in processes)
        for _ in range(steps):  # fewer than before the first trial of waiting awake
            env.step(np.zeros(workers, np.int64))
            time.sleep(0.01)
        after = sum(process.num_ctx_switches().voluntary for process in processes)
        assert after - before < 1.5 * steps * workers
