"""Asynchronous sub-environments: a process each, or shared ones where that is equal."""

import importlib.util
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import RemoteEnvWarning
from envhub_worker.runner import independence
from tests.support import inside
from tests.support.compare import assert_same
from tests.support.repositories import write_repository

N_ENVS = 3
_LONG_S = 600.0
REPOSITORY = '''
import os
import random
import time

import gymnasium as gym
import numpy as np

LOG = []
SHARED = {"steps": 0}

class Scene(gym.Env):
    """Each step gives one number, which depends on what its kind says."""

    observation_space = gym.spaces.Box(-1e9, 1e9, (1,), np.float64)
    action_space = gym.spaces.Discrete(2)
    built = 0

    def __init__(self, kind):
        self.kind = kind
        self.own = np.random.default_rng()
        type(self).built += 1
        self.number = type(self).built
        self.gain = 1.0
        self.late = False
        self.here = os.getcwd()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        if seed is not None and self.kind in SEEDS:
            SEEDS[self.kind](seed)
        if self.kind == "directory":
            os.makedirs(f"{self.here}/{self.number}", exist_ok=True)
            os.chdir(f"{self.here}/{self.number}")
        return np.array([0.0]), {}

    def step(self, action):
        self.t += 1
        draw = np.random.rand() if self.late else VALUES.get(self.kind, plain)(self)
        info = {"t": self.t, "object": object(), "clock": time.perf_counter()}
        return np.array([draw * self.gain]), float(draw), self.t == 5, False, info

def plain(scene):
    return scene.np_random.random()

def unseeded(scene):
    return plain(scene) + scene.own.random() + np.random.default_rng().random()

def counted(scene):
    Scene.total = getattr(Scene, "total", 0) + 1
    return plain(scene)

def logged(scene):
    LOG.append(scene.t)
    return len(LOG)

def exported(scene):
    last = os.environ.get("SCENE", scene.number)
    os.environ["SCENE"] = str(scene.number)
    return float(last)

def located(scene):
    return int(os.path.basename(os.getcwd()))

def closed_over(scene):
    SHARED["steps"] += 1
    return SHARED["steps"]

SEEDS = {"numpy": np.random.seed, "random": random.seed}
VALUES = {
    "numpy": lambda scene: np.random.rand(),
    "random": lambda scene: random.random(),
    "built": lambda scene: scene.number,
    "unseeded": unseeded,
    "counted": counted,
    "logged": logged,
    "exported": exported,
    "directory": located,
    "closed over": closed_over,
}

def make_env(n_envs=1, use_async_envs=False, kind="plain", mode="NEXT_STEP"):
    cls = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return cls(
        [lambda: gym.wrappers.RecordEpisodeStatistics(Scene(kind))] * n_envs,
        autoreset_mode=getattr(gym.vector.AutoresetMode, mode),
    )
'''


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """The folder; each is another one, so nothing is remembered of it."""
    return write_repository(tmp_path / "repository", f"# {tmp_path}\n{REPOSITORY}")


def processes(repository: Path, **kwargs: Any) -> int:
    with make_env(repository, N_ENVS, use_async_envs=True, **kwargs) as suites:
        return len(inside.bounds(suites.env))


@pytest.mark.parametrize(
    "env_kwargs", [{"kind": "unseeded"}, {"kind": "plain", "mode": "DISABLED"}], ids=str
)
def test_independent_sub_environments_share_processes(
    repository: Path, env_kwargs: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also those with a clock, a generator of their own and an object without a text in infos."""
    import os

    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1})
    assert processes(repository, env_kwargs=env_kwargs) == 2


KINDS = ["built", "counted", "exported", "directory"]


@pytest.mark.parametrize("kind", KINDS)
def test_those_that_share_something_have_a_process_each(repository: Path, kind: str) -> None:
    assert processes(repository, env_kwargs={"kind": kind}) == N_ENVS


def _sleep() -> None:
    while True:
        time.sleep(0.001)


def _fill() -> None:
    bytes(1 << 30)


@pytest.mark.parametrize(
    ("step", "error"), [(_sleep, independence.HeavyError), (_fill, MemoryError)]
)
def test_who_would_wait_for_ever_or_take_all_memory_is_given_up(
    step: Callable[[], None], error: type[Exception]
) -> None:
    """Sleeping takes no time there, so waiting for something would never end; and the kernel ends a
    jail with too little memory, whichever of its processes took it."""
    turns = independence.Turns()

    def give_up() -> bytes:
        turns.replace_sources()
        with pytest.raises(error):
            turns.run(0, step)
        return b"over"

    assert independence.in_fork(give_up, 0, _budget()) == b"over"


def _budget() -> independence.Budget:
    return independence.Budget(time.monotonic() + _LONG_S, 64 << 20)


def _wait() -> bytes:
    threading.Event().wait(_LONG_S)
    return b"over"


def _compute() -> bytes:
    began = time.process_time()
    while time.process_time() - began < 2.5:
        pass
    return b"over"


def test_a_play_may_compute_for_longer_than_it_may_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """What waits in its steps costs seconds at its first use; a busy machine changes no answer:
    by this clock, the fork that computes has a fifth of a processor.
    """
    assert independence.in_fork(_wait, 0, _budget()) is None
    clocks, clock_gettime = list[int](), time.clock_gettime

    def note(clock: int) -> float:
        clocks.append(clock)
        return clock_gettime(clock)

    monkeypatch.setattr(time, "clock_gettime", note)
    monkeypatch.setattr(
        independence, "monotonic", lambda: 5 * clock_gettime(clocks[-1]) if clocks else 0.0
    )
    assert independence.in_fork(_compute, 0, independence.Budget(_LONG_S, 64 << 20)) == b"over"


def play(env: Any) -> list[Any]:
    results: list[Any] = [env.reset(seed=7)[0].copy()]
    for _ in range(12):
        observation, *rest, _ = env.step(np.zeros(N_ENVS, np.int64))
        results.append((observation.copy(), *rest))
    return results


@pytest.mark.parametrize(
    ("kind", "where"),
    [
        *((kind, {}) for kind in ("numpy", "random", "logged")),
        ("closed over", {"policy": {"lane": "frames"}}),
        ("numpy", {"sandbox": ["process", "process"]}),
    ],
    ids=str,
)
def test_results_are_those_of_gymnasium_in_every_use(
    repository: Path, kind: str, where: dict[str, Any]
) -> None:
    """The first, and one whose answer is remembered: a process each."""
    spec = importlib.util.spec_from_file_location("independence_control", repository / "env.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    control = module.make_env(N_ENVS, use_async_envs=True, kind=kind)
    expected = play(control)
    control.close()
    for _ in range(2):
        given = {"env_kwargs": {"kind": kind}, "use_async_envs": True}
        with make_env(repository, N_ENVS, **given, **where) as suites:
            assert_same(play(suites.env), expected)
            assert "sandbox" in where or len(inside.bounds(suites.env)) == N_ENVS


@pytest.mark.parametrize("lane", ["auto", "frames"])
def test_what_is_shared_later_is_said_once_and_then_separated(repository: Path, lane: str) -> None:
    with make_env(repository, N_ENVS, use_async_envs=True, policy={"lane": lane}) as suites:
        env = suites.env
        env.reset(seed=1)
        assert len(inside.bounds(env)) < N_ENVS
        env.step(np.zeros(N_ENVS, np.int64))
        env.set_attr("late", True)
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            for _ in range(3):
                env.step(np.zeros(N_ENVS, np.int64))
    [warning] = [one for one in heard if issubclass(one.category, RemoteEnvWarning)]
    assert "np.random" in str(warning.message)
    assert "num_workers" in str(warning.message)
    assert processes(repository, policy={"lane": lane}) == N_ENVS


@pytest.mark.parametrize(
    ("kind", "options", "said"),
    [
        ("closed over", {"use_async_envs": True, "num_workers": 1}, ["not shown"]),
        ("numpy", {"use_async_envs": True, "num_workers": 2}, ["not shown", "np.random"]),
        ("numpy", {"num_workers": 2}, ["np.random"]),
        ("numpy", {"min_ready": 1}, ["np.random"]),
        ("numpy", {}, []),
        ("unseeded", {"use_async_envs": True, "num_workers": 1}, []),
        ("numpy", {"use_async_envs": True, "num_workers": N_ENVS}, []),
    ],
)
def test_an_explicit_number_of_processes_holds_and_is_said_if_results_may_depend_on_it(
    repository: Path, kind: str, options: dict[str, Any], said: list[str]
) -> None:
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        with make_env(repository, N_ENVS, env_kwargs={"kind": kind}, **options) as suites:
            play(suites.env)
            if "num_workers" in options:
                assert len(inside.bounds(suites.env)) == options["num_workers"]
    texts = [str(one.message) for one in heard if issubclass(one.category, RemoteEnvWarning)]
    assert len(texts) == len(said)
    assert all(words in text for words, text in zip(said, texts, strict=True))
