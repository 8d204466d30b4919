"""A repository's environment as an ordinary ``gymnasium.Env``: it gives and takes the same."""

import contextlib
import copy
import json
import pickle
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import TimeAwareObservation

from envhub_sandbox import SandboxEnv, make_env
from envhub_sandbox.errors import ActionError, LoadError
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.vector.vector_env import SandboxVectorEnv
from tests.support.compare import assert_same
from tests.support.repositories import STILL, write_repository
from tests.support.samples import EXAMPLES, make_env_of

_ID = "envhub_sandbox.integrations.gym:Hub-v0"


@pytest.fixture(autouse=True)
def _quiet() -> None:
    warnings.filterwarnings("ignore", module="gymnasium.*")


def test_gymnasiums_own_check_passes() -> None:
    """As for an environment that its author wrote here; a notebook shows its spaces, and its
    copy plays the same."""
    html = "_repr_html_"
    with contextlib.closing(SandboxEnv(EXAMPLES / "cartpole")) as env:
        check_env(env)
        assert "Discrete(2)" in getattr(env, html)()
        with contextlib.closing(copy.deepcopy(env)) as twin:
            assert np.array_equal(env.reset(seed=3)[0], twin.reset(seed=3)[0])
            assert env.step(1)[1:] == twin.step(1)[1:]


def test_gymnasium_makes_it_by_its_id() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = gym.make(_ID, ref=str(EXAMPLES / "cartpole"), limits={"processes": 32})
        assert isinstance(env.unwrapped, SandboxEnv)
        assert env.reset(seed=1)[0] in env.observation_space
        env.close()
        env.close()
        with pytest.raises(LoadError, match="make_env takes no render_mode"):  # it is handed on
            gym.make(_ID, ref=str(EXAMPLES / "cartpole"), render_mode="rgb_array")
        envs = gym.make_vec(_ID, num_envs=3, ref=str(EXAMPLES / "cartpole"))
        assert envs.reset(seed=1)[0].shape == (3, 4)
        envs.close()


def test_a_task_is_chosen_by_name() -> None:
    with pytest.raises(ValueError, match=r"\['maze'\]\[0\], \['maze'\]\[1\]"):
        SandboxEnv(EXAMPLES / "two_tasks")
    with pytest.raises(ValueError, match=r"no suite 'house'.*there are: \['maze'\]\[0\]"):
        SandboxEnv(EXAMPLES / "two_tasks", suite="house")
    env = SandboxEnv(EXAMPLES / "two_tasks", task=1)
    env.reset(seed=0)
    assert env.step(env.action_space.sample())[0] in env.observation_space
    env.close()
    assert env.vector.closed


# --- what it gives, and what is set ---------------------------------------------------------

_ENV = '''
import gymnasium as gym
import numpy as np

class Told(gym.Env):
    """Infos that a vector environment would join, and attributes that matter."""

    observation_space = gym.spaces.Dict([
        ("b", gym.spaces.Tuple([gym.spaces.Discrete(100), gym.spaces.Box(-1, 1, (2,))])),
        ("a", gym.spaces.Discrete(100)),
        ("height", gym.spaces.Box(-1, 1, ())),
    ])
    action_space = gym.spaces.Discrete(4)
    gravity = 10
    shape = (1,)
    _level = 1

    def __init__(self):
        self.steps = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        begun = {"begun": True, "level": self._level, "seed": seed}
        return self.seen(), {**begun, **(options or {})}

    def seen(self):
        step = self.steps
        shown = np.int64(step), np.full(2, step / 10, np.float32)
        return {"b": shown, "a": step, "height": np.array(step / 10, np.float32)}

    def step(self, action):
        self.steps += 1
        infos = [
            {"n": 1, "x": 0.5, "f": np.float32(2)},
            {"n": 2, "x": 1.5, "f": np.float32(3)},
            {"n": 2**80, "x": 0.5, "f": np.float32(2)},
            {"_a": 1, "a": 2, "kind": type(action).__name__},
            {"deep": {"x": {"y": [1, np.arange(3)]}}, "row": np.arange(2), 7: None},
            {},
            {"deep": 3, "gravity": self.gravity, 0: {"x": 1}, -1: (True,)},
        ]
        over = self.steps == len(infos)
        return self.seen(), 1.0, over, False, infos[min(self.steps, len(infos)) - 1]

class Outer(gym.Wrapper):
    colour = "red"

def make_env(n_envs=1, use_async_envs=False, mode="NextStep"):
    return gym.vector.SyncVectorEnv(
        [lambda: Outer(Told())] * n_envs, autoreset_mode=gym.vector.AutoresetMode(mode)
    )
'''


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_repository(tmp_path_factory.mktemp("told"), _ENV)


@pytest.fixture
def here(folder: Path) -> gym.Env[Any, Any]:
    return make_env_of(folder)().envs[0]


@pytest.fixture(params=["auto", "frames"])
def env(folder: Path, request: pytest.FixtureRequest) -> Iterator[Any]:
    with contextlib.closing(SandboxEnv(folder, policy={"lane": request.param})) as made:
        yield made


def _played(env: gym.Env[Any, Any]) -> list[Any]:
    with pytest.raises(gym.error.Error):
        env.reset(seed=[1])  # type: ignore[arg-type]
    seen: list[Any] = [env.reset(seed=True)]
    for _ in range(2):
        seen += [env.step(np.int64(1) if step % 2 else 1) for step in range(7)]
        # the episode that has ended is shown until the caller resets it, also by a step
        seen += [env.get_wrapper_attr("steps"), env.step(1), env.get_wrapper_attr("steps")]
        seen.append(env.reset(options={"episode": 2**70}))
    return seen


@pytest.mark.parametrize(
    ("mode", "lane"),
    [("NextStep", "auto"), ("SameStep", "auto"), ("Disabled", "auto"), ("NextStep", "frames")],
)
def test_what_it_gives_is_what_the_environment_gave(
    folder: Path, here: gym.Env[Any, Any], mode: str, lane: str
) -> None:
    """Observations and infos have the same keys, classes and values, in each autoreset mode, and
    nobody but the caller resets it."""
    options: Any = {"policy": {"lane": lane}, "env_kwargs": {"mode": mode}}
    with contextlib.closing(SandboxEnv(folder, **options)) as env:
        seen = _played(env)
    assert_same(_played(here), seen)
    assert (type(seen[1][0]["a"]), type(seen[1][0]["b"][0])) == (int, np.int64)
    json.dumps(seen[1][4]["n"])


_REWARDS = """
import gymnasium as gym
import numpy as np

class Rewarding(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (2,))
    action_space = gym.spaces.Discrete(9)
    each = [1, 0.5, np.float32(2), [1.0, 2], (1, [3]), {"a": 1.0}, np.array([1.5, 2]), None, "much"]

    def reset(self, *, seed=None, options=None):
        return np.zeros(2, np.float32), {}

    def step(self, action):
        infos = {"action": int(action)} if action % 2 else {}
        return np.zeros(2, np.float32), self.each[int(action)], action == 8, False, infos

class Numbered(Rewarding):
    count = 0

    def __init__(self, number):
        self.number = number

    def step(self, action):
        return super().step(action if self.number == 2 else 0)

def make_env(n_envs=1, use_async_envs=False):
    cls = gym.vector.AsyncVectorEnv if use_async_envs else gym.vector.SyncVectorEnv
    return cls([lambda i=i: Numbered(i if n_envs > 1 else 2) for i in range(n_envs)])
"""


@pytest.mark.parametrize("lane", ["auto", "frames"])
def test_a_reward_that_is_no_number_comes_as_it_is(
    tmp_path: Path, lane: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a single environment, with the step. A vector environment says whose it is, and can be
    used on."""
    asked = list[object]()
    send = WorkerConnection.send
    noted = lambda self, *request: (asked.append(request), send(self, *request))[1]  # noqa: E731
    folder = write_repository(tmp_path / "rewards", _REWARDS)
    here = make_env_of(folder)().envs[0]
    with contextlib.closing(SandboxEnv(folder, policy={"lane": lane})) as env:
        env.reset()
        monkeypatch.setattr(WorkerConnection, "send", noted)
        for action in (1, 1, 3, 1, 5, *range(9)):  # also where infos have become columns
            expected = here.step(action)
            seen = env.step(action)
            if action > 2:
                assert_same(expected, seen)
            assert_same(expected[2:], seen[2:])
            assert action > 2 or (type(seen[1]), seen[1]) == (float, expected[1])
        assert lane == "frames" or not asked, "a step was more than one request"
        env.reset()
        with pytest.raises(ValueError, match=r"environment 0 returned list"):
            env.vector.step([3])
    for is_async, workers in ((False, None), (True, 1), (True, 2)):
        options: Any = {"num_workers": workers, "policy": {"lane": lane}}
        with make_env(str(folder), 3, is_async, **options) as suites:
            suites.env.reset()
            for action, kind in ((3, "list"), (5, "dict"), (8, "str")):
                named = rf"sub-environment 2 returned {kind} .* as reward.*number"
                with pytest.raises((ValueError, TypeError), match=named):
                    suites.env.step([action] * 3)
            assert suites.env.step([1] * 3)[1].tolist() == [1.0, 1.0, 0.5]


def test_an_attribute_that_is_set_arrives(env: Any, folder: Path) -> None:
    """By the environment itself, unwrapped, and through a wrapper; it is read from there. The error
    for one that is not served names the method that sets it."""
    for number, target in enumerate([env, env.unwrapped, gym.Wrapper(env)]):
        if isinstance(target, gym.Wrapper):
            target.set_wrapper_attr("gravity", number)
        else:
            target.gravity = number
        assert env.gravity == number
        env.reset()
        assert [env.step(0) for _ in range(7)][-1][4]["gravity"] == number
    env.colour = "blue"
    assert env.vector.envs[0].colour == "blue"
    env.fresh = 3
    assert env.fresh == 3
    assert env.set_wrapper_attr("nowhere", 1, force=False) is False
    assert not env.has_wrapper_attr("nowhere")
    env.action_space = gym.spaces.Discrete(3)
    assert env.action_space == env.vector.call("action_space")[0] == gym.spaces.Discrete(3)
    with pytest.raises(AttributeError, match=r"no setter|can't set"):  # a wrapper's, as here
        env.render_mode = "human"
    assert env.render_mode is None
    for name, value in (("_level", 5), ("shape", (2,))):
        with pytest.raises(AttributeError, match="set_wrapper_attr"):
            setattr(env, name, value)
        assert env.set_wrapper_attr(name, value)
        assert env.get_wrapper_attr(name) == value
    assert env.reset()[1]["level"] == 5


class _Derived(SandboxEnv):
    """Has attributes of its own."""

    calls = 0

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._mine = 1
        self.calls = 2


def test_what_a_caller_sets_is_no_workers_fault(folder: Path) -> None:
    """A derived class keeps its own attributes. Results are read by the spaces that were declared.
    Gymnasium's classes are direct bases: some libraries look no further, skrl among them."""
    with contextlib.closing(_Derived(folder)) as env:
        assert (vars(env)["_mine"], env.calls) == (1, 2)
        assert not env.vector.envs[0].has_wrapper_attr("calls")
        env.observation_space = gym.spaces.Dict(other=gym.spaces.Discrete(2))
        assert env.reset(seed=1)[0]["a"] == 0
        assert type(env.step(1)[0]["a"]) is int
    assert gym.Env in SandboxEnv.__bases__
    assert gym.vector.VectorEnv in SandboxVectorEnv.__bases__


_EMPTY = """
import copy

import gymnasium as gym
import numpy as np

S = gym.spaces
SPACES = [
    S.Dict({}),
    S.Tuple(()),
    S.Dict({"a": S.Discrete(2), "c": S.Dict({})}),
    S.Tuple((S.Tuple(()), S.Box(-1, 1, (0, 2)), S.Dict(b=S.Text(3), c=S.Tuple(())))),
]

class Empty(gym.Env):
    def __init__(self, space):
        self.observation_space, self.action_space = copy.deepcopy(space), copy.deepcopy(space)

    def reset(self, *, seed=None, options=None):
        self.steps = 0
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {"none": (), "rows": np.zeros((0, 4))}

    def step(self, action):
        assert action in self.action_space
        self.steps += 1
        return action, 1.0, self.steps == 2, False, {"none": {}}

def make_env(n_envs=1, use_async_envs=False, kind=0, mode="NextStep"):
    return gym.vector.SyncVectorEnv(
        [lambda: Empty(SPACES[kind])] * n_envs, autoreset_mode=gym.vector.AutoresetMode(mode)
    )
"""


@pytest.mark.parametrize("kind", range(4))
@pytest.mark.parametrize("options", [{}, {"policy": {"lane": "frames"}}], ids=str)
def test_empty_mappings_and_tuples_are_members_too(
    tmp_path: Path, kind: int, options: dict[str, Any]
) -> None:
    """Of actions and of observations, also of the last of an episode."""
    folder = write_repository(tmp_path / "empty", _EMPTY)
    for mode in ("NextStep", "SameStep"):
        seen = []
        arguments = {"kind": kind, "mode": mode}
        for env in (
            make_env_of(folder)(**arguments).envs[0],
            SandboxEnv(folder, env_kwargs=arguments, **options),
        ):
            env.action_space.seed(3)
            begun = env.reset(seed=1)
            steps = [env.step(env.action_space.sample()) for _ in range(2)]
            seen.append([begun, *steps, env.reset(seed=2)])
            env.close()
        assert_same(*seen)


def test_its_actions_and_the_vector_environment_below(env: Any, folder: Path) -> None:
    """Infos are joined there; an error has the shapes of one action, and a bool arrives as one."""
    here = make_env_of(folder)()
    assert_same(here.reset(seed=1), env.vector.reset(seed=1))
    for _ in range(2):
        assert_same(here.step(np.array([1])), env.vector.step(np.array([1])))
    env.reset(seed=0)
    with pytest.raises(ActionError, match=r"int64 of shape \(\) for Discrete\(4\), got .* \(1,\)"):
        env.step([1])
    for _ in range(3):
        env.step(1)
    assert env.step(True)[4]["kind"] == "bool"


_MADE = """
import gymnasium as gym

class Plain(gym.Env):
    observation_space = gym.spaces.Box(-1, 1, (2,))
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.uniform(-1, 1, 2).astype("f4"), {}

    def step(self, action):
        return self.np_random.uniform(-1, 1, 2).astype("f4"), 0.0, False, False, {}

def make_env(n_envs=1, use_async_envs=False, plain=False):
    def one():
        if plain:
            return gym.wrappers.TimeLimit(Plain(), 7)
        return gym.make("CartPole-v1", render_mode="rgb_array")

    return gym.vector.SyncVectorEnv([one] * n_envs)
"""
_AGAIN: dict[str, Any] = {
    "gym.make": gym.make,
    "its own make": EnvSpec.make,
    "JSON": lambda spec: gym.make(EnvSpec.from_json(spec.to_json())),
    "a pickle": lambda spec: gym.make(pickle.loads(pickle.dumps(copy.deepcopy(spec)))),
    "make_vec": lambda spec: gym.make_vec(spec, num_envs=1),
}


def test_its_spec_makes_it_again(tmp_path: Path) -> None:
    """In a sandbox, by the same options but the token, which is in no file that has a spec. What
    Gymnasium and others check with copies (``check_env``, minari) works."""
    folder = write_repository(tmp_path / "made", _MADE)
    policy = {"restart": "on_reset", "limits": {"processes": 64}}
    options: dict[str, Any] = {"policy": policy, "timeouts": {"step_s": 50.0}, "copy": False}
    with contextlib.closing(SandboxEnv(folder, token="hf_secret", **options)) as env:
        spec = env.spec
        assert (spec.id, spec.max_episode_steps, spec.reward_threshold) == ("Hub-v0", 500, 475.0)
        assert spec.nondeterministic is False
        assert {**spec.kwargs, **options} == spec.kwargs
        assert "hf_secret" not in spec.to_json()
        first = env.reset(seed=4)[0]
        for how, make in _AGAIN.items():
            with contextlib.closing(make(spec)) as again:
                ours = SandboxVectorEnv if how == "make_vec" else SandboxEnv
                assert isinstance(again.unwrapped, ours), how
                assert np.array_equal(np.ravel(again.reset(seed=4)[0]), first), how
                assert again.spec.kwargs["policy"] == policy
        with pytest.raises(ValueError, match="=9 is not the repository's limit, 500"):
            gym.make_vec(spec, max_episode_steps=9)
        with pytest.warns(UserWarning, match="takes no render_mode, so it is 'rgb_array'"):
            check_env(env)
        env.spec = None
        assert env.spec is None


def test_a_time_limit_without_a_spec_is_known(tmp_path: Path) -> None:
    """As Gymnasium finds it by looking through the wrappers."""
    folder = write_repository(tmp_path / "made", _MADE)
    plain, played = {"plain": True}, []
    by_id = gym.make(_ID, ref=str(folder), env_kwargs=plain)
    here = make_env_of(folder)(plain=True).envs[0]
    for env in (here, SandboxEnv(folder, env_kwargs=plain), by_id):
        timed = TimeAwareObservation(env, normalize_time=True)
        seen = [timed.observation_space, timed.reset(seed=1), timed.step(1)]
        played.append([*seen, *(timed.step(0) for _ in range(6))])
        env.close()
    assert_same(played[:1] * 2, played[1:])


_ACTIONS = """
import gymnasium as gym
import numpy as np

class Told(gym.Env):
    observation_space = gym.spaces.Discrete(2)

    def __init__(self, kind):
        parts = [("b", gym.spaces.Discrete(5)), ("a", gym.spaces.Box(-1, 1, ()))]
        nested = gym.spaces.Tuple([gym.spaces.Dict(parts), gym.spaces.MultiBinary(2)])
        spoken = gym.spaces.Tuple([gym.spaces.Text(3), gym.spaces.Discrete(5)])
        self.action_space = {**dict(parts), "nested": nested, "spoken": spoken}[kind]

    def reset(self, *, seed=None, options=None):
        return 0, {}

    def step(self, action):
        return 0, 0.0, False, False, {"text": self.text_of(action)}

    def text_of(self, value):
        if isinstance(value, dict):
            return [(key, self.text_of(part)) for key, part in value.items()]
        if isinstance(value, tuple):
            return [self.text_of(part) for part in value]
        return [type(value).__name__, str(getattr(value, "dtype", "")), str(value)]

def make_env(n_envs=1, use_async_envs=False, kind="b"):
    return gym.vector.SyncVectorEnv([lambda: Told(kind)] * n_envs)
"""
_NUMBERS: list[Any] = [1, np.int64(2), np.array(3), np.array(1, np.uint8), np.array(2), 4]


@pytest.mark.parametrize("lane", ["auto", "frames"])
@pytest.mark.parametrize("kind", ["b", "a", "nested", "spoken"])
def test_an_action_arrives_as_it_is(tmp_path: Path, kind: str, lane: str) -> None:
    """Its numbers have their classes; its mappings have the order of the space."""
    folder = write_repository(tmp_path / "told", _ACTIONS)
    here = make_env_of(folder)(kind=kind).envs[0]
    flags, floats = np.array([1, 0], np.int8), np.array(0.5, np.float32)
    given = {
        "b": _NUMBERS,
        "a": [0.5, np.float32(0.25), floats, np.float64(0.5), floats],
        "nested": [({"b": number, "a": floats}, flags) for number in _NUMBERS],
        "spoken": [("abc", number) for number in _NUMBERS],
    }
    with contextlib.closing(
        SandboxEnv(folder, env_kwargs={"kind": kind}, policy={"lane": lane})
    ) as env:
        env.action_space.seed(3)
        for action in (*given[kind], *(env.action_space.sample() for _ in range(3))):
            assert env.step(action)[4] == here.step(action)[4]


_GROWING = """
class Growing(Still):
    def reset(self, *, seed=None, options=None):
        if options:
            self.action_space = gym.spaces.Discrete(options["size"], seed=seed)
        return 0, {}
"""


@pytest.mark.parametrize("lane", ["auto", "frames"])
def test_a_space_that_a_reset_replaces_is_seen(tmp_path: Path, lane: str) -> None:
    """With its seed; another reset leaves the caller's copy as it is."""
    folder = write_repository(tmp_path / "growing", STILL + _GROWING)
    seen = []
    with contextlib.closing(SandboxEnv(folder, policy={"lane": lane})) as env:
        for each in (make_env_of(folder)().envs[0], env):
            each.reset()
            spaces = [str(each.action_space)]
            each.reset(seed=3, options={"size": 50})
            own = each.action_space
            draws = [own.sample() for _ in range(3)]
            each.reset()
            spaces += [str(own), str(each.action_space is own)]
            seen.append([*spaces, *draws, own.sample()])
    assert seen[0] == seen[1]
