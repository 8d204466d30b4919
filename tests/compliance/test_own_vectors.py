"""Repositories' own vector environments, wrapped ones, and old or odd results and errors."""

import builtins
import itertools
import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import gymnasium as gym
import gymnasium.error as gym_errors
import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import (
    ActionError,
    RemoteEnvError,
    RemoteEnvWarning,
    RemoteProtocolError,
)
from envhub_sandbox.transport.jail import JailHandle
from envhub_sandbox.transport.shared_memory import lane
from envhub_sandbox.transport.shared_memory.attachment import Attachment
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.shared_memory.columns import StepColumns
from tests.support import inside
from tests.support.compare import assert_same
from tests.support.in_process.interrupts import before_line
from tests.support.repositories import write_repository

_TIMED = """
import time

import gymnasium as gym
import numpy as np

class Timed(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        begun = time.monotonic()
        time.sleep(0.1)
        info = {"span": (begun, time.monotonic())}
        return np.zeros(1, np.float32), float(self.np_random.random()), False, False, info

def make_env(n_envs=1, use_async_envs=False, **arguments):
    return gym.vector.AsyncVectorEnv([Timed] * n_envs, **arguments)
"""
_OWN = """
import gymnasium as gym
import numpy as np

class Own(gym.vector.VectorEnv):
    def __init__(self, n, case):
        self.num_envs, self.case = n, case
        self.single_observation_space = gym.spaces.Box(0, 1, (2,))
        self.single_action_space = gym.spaces.Discrete(2)
        self.observation_space = gym.spaces.Box(0, 1, (n, 2))
        self.action_space = gym.spaces.MultiDiscrete([2] * n)

    def reset(self, *, seed=None, options=None):
        infos = [{"i": i} for i in range(self.num_envs)]
        if self.case == "no info":
            return np.zeros((self.num_envs, 2), np.float32)
        return np.zeros((self.num_envs, 2), np.float32), infos

    def step(self, actions):
        n = self.num_envs
        results = {
            "rewards": {
                "none": [None] * n,
                "masked": np.ma.masked_array(np.zeros(n)),
                "words": np.array(["a"] * n),
            }.get(self.case, [0.5] * n),
            "terminations": [False] * n,
            "truncations": [False] * n,
            "infos": "none" if self.case == "infos" else [{"i": i, "x": 0.5} for i in range(n)],
        }
        return np.zeros((n, 2), np.float32), *results.values()

def make_env(n_envs=1, use_async_envs=False, case=""):
    return Own(n_envs, case)
"""


def test_lists_are_what_gymnasium_would_make_of_them(tmp_path: Path) -> None:
    """Infos, rewards and flags, as other libraries' vector environments return them."""
    with make_env(write_repository(tmp_path, _OWN), n_envs=2) as suites:
        env = suites.env
        infos = env.reset()[1]
        assert (infos["i"].tolist(), infos["_i"].tolist()) == ([0, 1], [True, True])
        _, rewards, over, cut, infos = env.step([0, 1])
        assert (rewards.tolist(), rewards.dtype.kind) == ([0.5, 0.5], "f")
        assert (over.tolist(), cut.tolist()) == ([False, False], [False, False])
        assert infos["x"].tolist() == [0.5, 0.5]


@pytest.mark.parametrize("case", ["none", "masked", "words", "infos", "no info"])
def test_what_is_none_of_it_is_named(tmp_path: Path, case: str) -> None:
    """It is the repository's fault, not the wire's; the environment stays usable."""
    with make_env(write_repository(tmp_path, _OWN), n_envs=2, env_kwargs={"case": case}) as suites:
        env = suites.env
        what = {"no info": "in place of", "infos": "infos"}.get(case, "rewards")
        if case != "no info":
            env.reset()
        with pytest.raises(RemoteEnvError, match=f"make_env returned a VectorEnv .*Own.*{what}"):
            _ = env.reset() if case == "no info" else env.step([0, 1])
        assert case in env.get_attr("case")


_GRAPHS = """
import gymnasium as gym
import numpy as np

class Graphs(gym.vector.VectorEnv):
    def __init__(self, n):
        self.num_envs = n
        graph = gym.spaces.Graph(gym.spaces.Box(0, 1, (2,)), None, seed=1)
        self.single_observation_space = gym.spaces.Dict(z=graph, a=gym.spaces.Discrete(2))
        self.single_action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        graph = self.single_observation_space["z"]
        graph.seed(seed)
        return {"z": (graph.sample(),), "a": np.zeros(self.num_envs, np.int64)}, {}

def make_env(n_envs=1, use_async_envs=False):
    return Graphs(n_envs)
"""


def test_graphs_keep_their_class_in_a_batch_of_any_length_and_order(tmp_path: Path) -> None:
    names: dict[str, Any] = {}
    exec(_GRAPHS, names)
    with make_env(write_repository(tmp_path, _GRAPHS), n_envs=2) as suites:
        assert_same(names["make_env"](2).reset(seed=3), suites.env.reset(seed=3))


_WRAPPED = """
import gymnasium as gym

class Inner(gym.Wrapper):
    level = 3
    def raised(self, by):
        return self.level + by

class Outer(gym.vector.VectorWrapper):
    level = "the wrapper's"

def make_env(n_envs=1, use_async_envs=False):
    fns = [lambda: Inner(gym.make("CartPole-v1"))] * n_envs
    return Outer(Outer(gym.vector.SyncVectorEnv(fns)))
"""


def test_a_vector_wrapper_passes_calls_on(tmp_path: Path) -> None:
    """``call``, ``get_attr`` and ``set_attr`` are the sub-environments'."""
    with make_env(write_repository(tmp_path, _WRAPPED), n_envs=2) as suites:
        env = suites.env
        assert env.get_attr("level") == (3, 3)
        env.set_attr("level", [4, 5])
        assert (env.get_attr("level"), env.call("raised", 1)) == ((4, 5), (5, 6))
        assert env.level == "the wrapper's"


_OLD = """
import gymnasium as gym
import numpy as np

class Old(gym.Env):
    observation_space = gym.spaces.Box(0, 1, (3,))
    action_space = gym.spaces.Discrete(2)

    RESET

    def step(self, action):
        return np.zeros(3, np.float32), 0.0, False, {}

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([lambda: gym.wrappers.OrderEnforcing(Old())] * n_envs)
"""
_RESETS = {
    "def reset(self, seed=None, options=None): return np.zeros(3)": r"line 9\) does not return obs",
    "def reset(self, seed=None, options=None): return np.zeros(3), {}": (
        r"Old.step \(env.py, line 11\) does not return observation, reward, terminated, truncated"
    ),
}


@pytest.mark.parametrize("text", _RESETS)
def test_the_api_of_old_is_named_with_its_line(tmp_path: Path, text: str) -> None:
    """What ``gym`` before 0.26 had, in an environment whose ``reset`` looks like today's."""
    step = "step" in _RESETS[text]
    folder = write_repository(tmp_path, _OLD.replace("RESET", text))
    with make_env(folder) as suites:
        if step:
            suites.env.reset()
        with pytest.raises(RemoteEnvError, match=_RESETS[text]) as caught:
            _ = suites.env.step([0]) if step else suites.env.reset()
    assert "0.26" in str(caught.value)
    assert (caught.value.file, caught.value.line) == ("env.py", 12 if step else 9)


_OF_OLD = """
import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding

class Old(gym.Env):
    observation_space = gym.spaces.Box(0, 1, (3,), np.float64)
    action_space = gym.spaces.Discrete(2)
    metadata = {"render.modes": ["rgb_array"]}
    SEED

    def reset(RESET):
        BODY
        self.steps = 0
        return self.np_random.random(3)

    def step(self, action):
        self.steps += 1
        info = {"TimeLimit.truncated": True} if self.steps == 3 and action else {}
        return self.np_random.random(3), 1.0, self.steps == 3, info

    def render(self, mode="human"):
        return np.full((2, 2, 3), self.steps, np.uint8) if mode == "rgb_array" else None

class Doubled(gym.Wrapper):
    def reset(self):
        return self.env.reset() / 2

    def step(self, action):
        observation, reward, done, info = self.env.step(action)
        return observation / 2, 2 * reward, done, info

gym.register("Old-v0", Old, max_episode_steps=2)
MAKERS = {
    "bare": Old,
    "registered": lambda: gym.make("Old-v0"),
    "wrapped": lambda: gym.wrappers.OrderEnforcing(Doubled(Old())),
}

class Seen(gym.vector.VectorWrapper):
    def __init__(self, env):
        super().__init__(env)
        self.seen = env.single_action_space

def make_env(n_envs=1, use_async_envs=False, kind="bare", around=None):
    if around == "single":
        return MAKERS[kind]()
    vector = gym.vector.SyncVectorEnv if around != "async" else gym.vector.AsyncVectorEnv
    env = vector([MAKERS[kind]] * n_envs)
    return Seen(env) if around else env
"""
_SEEDS = {
    "": "self",
    "def seed(self, seed=None): self.np_random, _ = seeding.np_random(seed)": "self, options=None",
    "has_return_info = True": "self, *, seed=None, return_info=False, options=None",
}


@pytest.mark.parametrize("seed", _SEEDS)
@pytest.mark.parametrize("around", [None, "single", "wrapper", "async"])
@pytest.mark.parametrize(("kind", "scale"), [("bare", 1), ("registered", 1), ("wrapped", 2)])
def test_a_reset_of_old_is_converted_and_told(
    tmp_path: Path, seed: str, around: str, kind: str, scale: int, recwarn: Any
) -> None:
    """By its signature, below the first wrapper that is of today."""
    body = "super().reset(seed=seed)" if "return_info" in seed else "pass"
    text = _OF_OLD.replace("RESET", _SEEDS[seed]).replace("SEED", seed).replace("BODY", body)
    expected = np.random.Generator(np.random.PCG64(5)).random((4, 3)) / scale
    steps = 2 if kind == "registered" else 3  # its time limit
    folder, kwargs = write_repository(tmp_path, text), {"kind": kind, "around": around}
    with make_env(folder, n_envs=2, env_kwargs=kwargs) as suites:
        env = suites.env
        rows, flags = [env.reset(seed=5)[0][0]], []
        for _ in range(steps):
            observation, rewards, over, cut, _ = env.step([1, 0])
            rows.append(observation[0])
            flags.append((over.tolist(), cut.tolist()))
            assert rewards.tolist() == [scale, scale]
        assert env.render()[0][0, 0, 0] == steps
    assert np.array_equal(rows, expected[: steps + 1])
    told = [str(one.message) for one in recwarn if one.category is RemoteEnvWarning]
    assert len([text for text in told if "as before Gymnasium 0.26" in text]) == 1
    no, end = [False, False], ([False, True], [True, False])
    assert flags == ([(no, no), (no, [True, True])] if steps == 2 else [(no, no), (no, no), end])


_DIFFERING = """
import gymnasium as gym
import numpy as np

class Sized(gym.Env):
    def __init__(self, seen, moves):
        self.observation_space = gym.spaces.Dict(a=gym.spaces.Box(0, 1, (seen,)))
        self.action_space = gym.spaces.Discrete(moves)

    def reset(self, *, seed=None, options=None):
        return {"a": np.zeros(self.observation_space["a"].shape, np.float32)}, {}

def make_env(n_envs=1, use_async_envs=False, sizes=()):
    fns = [lambda size=size: Sized(*size) for size in sizes]
    kind = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return kind(fns)
"""


@pytest.mark.parametrize("use_async_envs", [False, True])
@pytest.mark.parametrize(
    "sizes",
    [
        ((2, 2), (2, 2), (3, 2), (4, 2)),
        ((2, 2), (2, 2), (2, 3), (2, 4)),
        ((2, 2), (2, 2), (2, 2), (2, 3)),
    ],
)
def test_spaces_that_differ_are_refused_as_by_gymnasium(
    tmp_path: Path, sizes: Any, use_async_envs: bool
) -> None:
    """With its text, whatever the number of workers, and where a slice differs in itself."""
    folder = write_repository(tmp_path, _DIFFERING)
    kwargs: dict[str, Any] = {"use_async_envs": use_async_envs}
    namespace: dict[str, Any] = {}
    exec(_DIFFERING, namespace)
    with pytest.raises(RuntimeError) as expected:
        namespace["make_env"](sizes=sizes, **kwargs)
    for workers in (None, 1, 2, 3, 4):
        given = {"n_envs": 4, "env_kwargs": {"sizes": sizes}, "num_workers": workers, **kwargs}
        with pytest.raises(RuntimeError) as caught, make_env(folder, **given) as suites:
            suites.env.reset()
        assert str(expected.value) in str(caught.value)
        assert isinstance(caught.value, RemoteEnvError)


_RAISING = """
import gymnasium as gym
from gymnasium import error

class Raising(gym.Wrapper):
    def fail(self, name):
        raise {
            "CustomSpaceError": lambda: error.CustomSpaceError("a"),
            "AlreadyPendingCallError": lambda: error.AlreadyPendingCallError("a", "step"),
            "NoAsyncCallError": lambda: error.NoAsyncCallError("a", "step"),
            "ClosedEnvironmentError": lambda: error.ClosedEnvironmentError("a"),
            "ResetNeeded": lambda: error.ResetNeeded("a"),
            "UnicodeDecodeError": lambda: UnicodeDecodeError("utf-8", b"a", 0, 1, "why"),
            "ExceptionGroup": lambda: ExceptionGroup("several", [ValueError("a")]),
            "UserWarning": lambda: UserWarning("a"),
            "BrokenPipeError": lambda: BrokenPipeError(32, "a"),
        }[name]()

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([lambda: Raising(gym.make("CartPole-v1"))] * n_envs)
"""


def test_errors_are_of_their_class(tmp_path: Path) -> None:
    """Gymnasium's, and Python's that are made of more than a text."""
    names = ["UnicodeDecodeError", "UserWarning", "CustomSpaceError", "AlreadyPendingCallError"]
    names += ["NoAsyncCallError", "ClosedEnvironmentError", "ResetNeeded"]
    names += ["ExceptionGroup"] if hasattr(builtins, "ExceptionGroup") else []
    with make_env(write_repository(tmp_path, _RAISING)) as suites:
        env = suites.env
        env.reset()
        for name in names:
            kind: Any = getattr(gym_errors, name, None) or getattr(builtins, name)
            with pytest.raises(kind) as caught:
                env.call("fail", name)
            assert isinstance(caught.value, RemoteEnvError)
            assert name in str(caught.value)
            assert type(caught.value).__name__ == f"Remote{name}"
        with pytest.raises(OSError, match="BrokenPipe"):
            env.call("fail", "BrokenPipeError")
        assert len(env.get_attr("render_mode")) == 1


def _side_by_side(spans: Any) -> int:
    """How many of these spans of time at most have a moment in common."""
    return max(sum(begun <= moment < end for begun, end in spans) for moment, _ in spans)


@pytest.mark.skipif(not hasattr(gym.vector, "AutoresetMode"), reason="an argument of Gymnasium 1.4")
@pytest.mark.parametrize("bound", [1, 2])
def test_no_more_step_at_a_time_than_the_repository_permits(bound: int, tmp_path: Path) -> None:
    """``max_concurrency``, whatever the number of workers; results are the same."""
    folder = write_repository(tmp_path, _TIMED)
    rewards = []
    for given in ({"max_concurrency": bound}, {}):
        with make_env(folder, 4, env_kwargs=given, num_workers=4) as suites:
            suites.env.reset(seed=3)
            _, reward, *_, infos = suites.env.step(np.zeros(4, np.int64))
            rewards.append(reward.tolist())
            if given:
                assert _side_by_side(infos["span"]) <= bound
    assert rewards[0] == rewards[1]


@pytest.mark.parametrize("given", [{"max_concurrency": 0}, {"context": "spoon"}])
def test_an_argument_that_gymnasium_refuses_is_refused(given: Any, tmp_path: Path) -> None:
    folder = write_repository(tmp_path, _TIMED)
    with pytest.raises(ValueError, match=next(iter(given)).partition("_")[0]):
        make_env(folder, 2, env_kwargs=given)


_PLAIN = '''
from collections import namedtuple

import gymnasium as gym
import numpy as np
import torch

Fact = namedtuple("Fact", ["source", "step"])

class Batch(gym.vector.VectorEnv):
    """Steps all at once; what it returns changes its form from step to step."""

    def __init__(self, n, mode, wide):
        self.num_envs = n
        self.metadata = {"autoreset_mode": gym.vector.AutoresetMode(mode)}
        seen = gym.spaces.Dict({
            "camera": gym.spaces.Box(0, 255, (60, 80, 3), np.uint8),
            "joints": gym.spaces.Box(-9, 9, (wide,)),
        })
        self.single_observation_space = seen
        self.observation_space = gym.vector.utils.batch_space(seen, n)
        single = gym.spaces.Box(-1, 1, (2,))
        batch = gym.vector.utils.batch_space(single, n)
        spaces = (gym.Space(), gym.Space()) if mode == "Disabled" else (single, batch)
        self.single_action_space, self.action_space = spaces  # one takes whatever it is given
        self.count, self.wide = 0, wide

    def seen(self):
        n, at = self.num_envs, self.count
        camera = np.full((n, 60, 80, 3), at, np.uint8)
        kinds = np.float32, np.float64, ">f4", np.int64
        joints = np.full((n, self.wide), at / 7).astype(kinds[at // 9 % 4])
        is_tensor = at % 2 and at < 9
        return {"camera": camera, "joints": torch.as_tensor(joints) if is_tensor else joints}

    def reset(self, *, seed=None, options=None):
        self.count = 0 if seed is None else seed
        return self.seen(), {"log": {"lr": 0.5}, "text": ["a", None]}

    def step(self, actions):
        self.count += 1
        n, at = self.num_envs, self.count
        if at == 5:
            raise ValueError(f"no step {at}")
        steady = at > 20  # but for its ends of episodes
        rewards = torch.as_tensor(actions).sum(1) if at % 3 and not steady else actions.sum(1)
        done = np.arange(n) == at % n
        infos = {
            "distance": np.arange(n) / (at + 1), "_distance": ~done,
            "log": {"loss": at / 3, "steps": at, "name": "run", "grad": torch.full((2,), at)},
            "norms": [torch.tensor(at / 3, requires_grad=True), torch.tensor(at / 7)],
            "best": np.float32(at / 7), "own": [at % 2 == 0, Fact(None, np.int16(at)), f"{at}"],
            "time": 0 if steady else np.datetime64(at, "ns"),
        }
        if at % 4 == 1:
            finals = np.full(n, None, dtype=object)
            finals[at % n] = {name: part[0] for name, part in self.seen().items()}
            infos |= {"final_obs": finals, "_final_obs": done, "final_info": {"r": done * 0.5}}
        if at % 7 == 6 and not steady:
            infos["trace"] = np.arange(500_000) + at
        flags = torch.as_tensor(done) if at % 5 == 2 and not steady else done
        flags = flags.tolist() if at == 42 else flags
        return self.seen(), rewards[:-1] if at in (8, 40) else rewards, flags, ~done, infos

    def call(self, name, *args):
        return tuple(getattr(self, name) for _ in range(self.num_envs))

def make_env(n_envs=1, use_async_envs=False, mode="NextStep", wide=3, tasks=1):
    return {"suite": {task: Batch(n_envs, mode, wide + task) for task in range(tasks)}}
'''


def _played(envs: list[Any]) -> list[Any]:
    """What they return and raise in turns, and again once all of it has come."""
    heard: list[Any] = [env.reset(seed=seed) for seed, env in enumerate(envs)]
    actions = np.zeros((2, 2), ">f4")
    for number, env in itertools.product(range(80), envs):
        actions[:] = number // 3
        try:
            heard.append(env.step(actions))
        except (RemoteEnvError, RemoteProtocolError) as error:
            heard.append(f"{type(error).__mro__[1].__name__}: {error}".partition("\n")[0])
        if number % 10 == 0:
            heard += [env.call("count"), env.reset() if number == 20 else env.get_attr("wide")]
    with pytest.raises((RemoteEnvError, ActionError)) as caught:
        envs[0].step(np.array([*[None] * 9000, np.zeros(3000)], object))
    return [*heard, f"{caught.value}".partition("\n")[0]]


@pytest.mark.parametrize(
    ("mode", "wide", "copy", "tasks", "restart"),
    [
        ("NextStep", 3, True, 1, "never"),
        ("SameStep", 20_000, False, 1, "transparent"),
        ("Disabled", 3, False, 2, "never"),
    ],
)
def test_an_own_vector_is_stepped_in_shared_memory_and_returns_the_same(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    mode: str,
    wide: int,
    copy: bool,
    tasks: int,
    restart: str,
) -> None:
    """Whatever it returns, also where that does not fit, or changes its form; and its errors.
    Also where several share a process, and where a process that dies is replaced."""
    pytest.importorskip("torch")
    read = Mock(side_effect=StepColumns.read)
    folder = write_repository(tmp_path, _PLAIN)
    options: dict[str, Any] = {"env_kwargs": {"mode": mode, "wide": wide, "tasks": tasks}}
    options |= {"copy": copy, "n_envs": 2}
    heard, relayed = {}, Counter[str]()
    relay = JailHandle.send_relay

    def counted(self: JailHandle, message: m.Relay, *args: Any) -> int:
        relayed[message.operation] += 1
        return relay(self, message, *args)

    monkeypatch.setattr(JailHandle, "send_relay", counted)
    monkeypatch.setattr(StepColumns, "read", lambda *args, **kwargs: read(*args, **kwargs))
    for kind in ("frames", "auto"):
        with make_env(folder, policy={"lane": kind, "restart": restart}, **options) as suites:
            envs = list(suites["suite"].values())
            owned = [env.reset()[0]["camera"].flags.owndata for env in envs]
            assert owned == [copy or kind == "frames"] * tasks
            relayed.clear()
            heard[kind] = _played(envs)
            by_server = dict(relayed)
    assert_same(heard["frames"], heard["auto"])
    assert by_server == {"step": 6 * tasks}  # infos that do not fit
    assert read.call_count > 10 * tasks
    errors = [text for text in heard["auto"] if isinstance(text, str)]
    assert len(errors) == 5 * tasks + 1
    assert ["no step 5" in errors[0], "rewards" in errors[tasks]] == [True, True]


def test_environments_of_one_jail_get_their_own_slabs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where another one gives its slabs to the same process at that moment."""
    pytest.importorskip("torch")
    folder = write_repository(tmp_path, _PLAIN)
    both, hand_over = threading.Barrier(2), Attachment.hand_over

    def slowly(self: Attachment, *args: Any) -> None:
        hand_over(self, *args)
        with suppress(threading.BrokenBarrierError):
            both.wait(1)

    monkeypatch.setattr(Attachment, "hand_over", slowly)
    with make_env(folder, 2, env_kwargs={"tasks": 2}) as suites, ThreadPoolExecutor(2) as pool:
        envs = suites["suite"]
        resets = [pool.submit(envs[task].reset, seed=task) for task in range(2)]
        seen = [reset.result()[0] for reset in resets]
        seen += [envs[task].step(np.zeros((2, 2), np.float32))[0] for task in range(2)]
    assert [set(each["camera"].flat) for each in seen] == [{0}, {1}, {1}, {2}]


def test_an_interrupted_step_leaves_the_next_reset_its_own(tmp_path: Path) -> None:
    """Wherever the interrupt comes, also where the answer's slot is chosen and not written yet."""
    pytest.importorskip("torch")
    folder = write_repository(tmp_path, _PLAIN)
    with make_env(folder, 2, copy=False) as suites:
        env = suites.env
        moment, came, jails = 0, True, set()
        while came:
            env.reset(seed=9)
            held = [env.step(np.zeros((2, 2), np.float32)) for _ in range(3)]
            came = before_line(lane.__file__, moment, lambda: env.step(np.ones((2, 2), np.float32)))
            observation, _ = env.reset(seed=moment % 200)
            assert set(observation["camera"].flat) == {moment % 200}
            assert [set(each[0]["camera"].flat) for each in held] == [{10}, {11}, {12}]
            jails.add(inside.jail(env).number)
            moment += 1
            del held, observation  # so that the next slot is one that was never written
        assert (len(jails), moment > 10) == (1, True)
