"""What Gymnasium's own tests ask of a vector environment, asked of ours; its releases ship none.
Written anew after ``tests/vector`` of its repository. Each test runs on ``SyncVectorEnv`` in this
process, so that it says what is so there, and on each way to have the same in a sandbox."""

import multiprocessing
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import AlreadyPendingCallError, NoAsyncCallError
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_differing_spaces

from tests.compliance.theirs.through_sandbox import vector
from tests.remote.listening import Listening, listening

Make = Callable[..., Any]
WAYS: dict[str, dict[str, Any]] = {
    "sync": {},
    "async": {"use_async_envs": True},
    "subclass": {"options": {"env_kwargs": {"subclass": True}}},
    "frames": {"options": {"policy": {"lane": "frames"}}},
    "workers": {"use_async_envs": True, "options": {"num_workers": 2}},
}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Listening]:
    with listening(tmp_path_factory.mktemp("server")) as found:
        yield found


ALL = ["gymnasium", *WAYS, "tcp"]
EACH_PATH = [one for one in ALL if one not in ("async", "tcp")]
"""Several workers are those of ``async``, and messages are those of ``tcp``."""


@pytest.fixture(params=EACH_PATH)
def make(request: pytest.FixtureRequest) -> Iterator[Make]:
    """``SyncVectorEnv``, and whatever must be like it; what is made is closed."""
    made: list[Any] = []

    def build(env_fns: Any, **kwargs: Any) -> Any:
        if request.param == "gymnasium":
            made.append(SyncVectorEnv(env_fns, **kwargs))
        elif request.param == "tcp":
            place: Listening = request.getfixturevalue("server")
            made.append(vector(env_fns, options={"sandbox": place.sandbox()}, **kwargs))
        else:
            made.append(vector(env_fns, **WAYS[request.param], **kwargs))
        return made[-1]

    yield build
    for env in made:
        env.close()


@pytest.fixture(params=["async", "frames", "workers"])
def halves(request: pytest.FixtureRequest) -> Make:
    return partial(vector, **{"use_async_envs": True, **WAYS[request.param]})


class Shown(gym.Env[Any, Any]):
    """Shows samples of a space; asserts that actions are in it, too."""

    def __init__(self, space: gym.Space[Any], infos: Any = None, slow: float = 0.0) -> None:
        self.observation_space = self.action_space = space
        self.infos = infos or [{}]
        self.slow = slow

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """A sample, and the first of its infos."""
        super().reset(seed=seed)
        time.sleep(self.slow)
        return self.observation_space.sample(), self.infos[0]

    def step(self, action: Any) -> Any:
        """A sample, and the last of its infos."""
        assert action in self.action_space, f"{action!r} is not in {self.action_space}"
        time.sleep(self.slow)
        return self.observation_space.sample(), 0.0, False, False, self.infos[-1]


def shown(space: gym.Space[Any], *infos: dict[str, Any], slow: float = 0.0) -> Callable[[], Shown]:
    return partial(Shown, space, infos, slow)


def carts(count: int) -> list[Callable[[], gym.Env[Any, Any]]]:
    return [partial(gym.make, "CartPole-v1")] * count


UNIT = spaces.Box(0, 1, (2,))
GRAPH = spaces.Graph(spaces.Box(-1, 1, (2,)), spaces.Discrete(3))
WITHIN: list[gym.Space[Any]] = [
    spaces.Dict(
        {
            "b": spaces.MultiBinary(3),
            "a": spaces.Tuple([spaces.Discrete(3, start=-1)]),
            "0": spaces.Box(-1, 1, (), np.float16),
        }
    ),
    GRAPH,
    spaces.Tuple([spaces.Dict({"g": GRAPH}), spaces.Sequence(UNIT, stack=True), spaces.Text(5)]),
    spaces.OneOf([spaces.Sequence(GRAPH), UNIT]),
]


@pytest.mark.parametrize("space", WITHIN, ids=repr)
def test_actions_and_observations_are_in_their_spaces(make: Make, space: Any) -> None:
    """On both sides, nested as they may be, with the classes that the space asks for."""
    env = make([shown(space)] * 3)
    assert env.observation_space == env.action_space
    observation, _ = env.reset(seed=1)
    assert observation in env.observation_space
    env.action_space.seed(1)
    for _ in range(3):
        observation, *_ = env.step(env.action_space.sample())
        assert observation in env.observation_space


def test_spaces_may_differ_if_that_is_said(make: Make) -> None:
    boxes = [spaces.Box(0, high, (5,)) for high in (1, 2, 3)]
    env_fns = [shown(box) for box in boxes]
    both = (spaces.Box(0, 4, (3, 5)), spaces.Box(0, 4, (5,)))
    with pytest.raises(RuntimeError, match="observation_mode='different'"):
        make(env_fns).reset()
    with pytest.raises(ValueError, match="Invalid `observation_mode`"):
        make([shown(UNIT)] * 2, observation_mode="invalid").reset()
    for mode, batched in (("different", batch_differing_spaces(boxes)), (both, both[0])):
        # their actions are one space each, and have to agree
        env = make([partial(WithActions, box) for box in boxes], observation_mode=mode)
        assert env.observation_space == batched
        observation, _ = env.reset(seed=1)
        assert observation in env.observation_space
        assert env.step(env.action_space.sample())[0] in env.observation_space


class WithActions(Shown):
    """With actions that all of them have."""

    def __init__(self, space: gym.Space[Any]) -> None:
        super().__init__(space)
        self.action_space = spaces.Discrete(2)


MIXED: list[tuple[Any, ...]] = [
    (1, 2.5, True),
    (0.5, 1, np.int8(2)),
    ("a", 1, None),
    ({"x": 1}, {"x": 0.5}, {"y": None}),
    (None, 1, np.float32(2)),
    ({"x": 1}, None, {"x": 2}),
    (np.zeros(2), np.ones(2, np.int8), 3),
]


def test_infos_of_several_kinds(make: Make) -> None:
    """The first sub-environment that has a key decides what the others' values become."""
    rows = zip(*((*values, values[0]) for values in MIXED), strict=True)
    env_fns = [shown(UNIT, {f"k{key}": value for key, value in enumerate(row)}) for row in rows]
    expected, actual = SyncVectorEnv(env_fns), make(env_fns)
    assert repr(actual.reset(seed=0)[1]) == repr(expected.reset(seed=0)[1])
    actions = np.zeros((4, 2), np.float32)
    assert repr(actual.step(actions)[4]) == repr(expected.step(actions)[4])


def test_infos_that_cannot_be_joined(make: Make) -> None:
    """It raises what it raises there, and can be used on."""
    env = make([shown(UNIT, {}, {"k": value}) for value in (1, 2, 3, "text")])
    env.reset(seed=0)
    with pytest.raises(ValueError, match="invalid literal"):
        env.step(np.zeros((4, 2), np.float32))
    env.reset(seed=0)


def test_what_is_refused_in_gymnasiums_words(make: Make) -> None:
    """Another number of actions than one each, and seeds that are no integers; and what an
    environment raises of ``gymnasium.error`` is the same on both sides."""
    env = make(carts(3))
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(3, np.int64))
    env.reset(seed=0)
    for actions in ([0, 1], [0, 1, 0, 1]):
        with pytest.raises(ValueError):  # noqa: PT011
            env.step(np.array(actions))
    with pytest.raises(TypeError):
        env.step(0)
    with pytest.raises(TypeError):
        env.reset(seed=np.int64(3))
    with pytest.raises(gym.error.Error, match="Seed must be a python integer"):
        env.reset(seed=[np.int64(1), 2, 3])


@pytest.mark.parametrize("make", ALL, indirect=True)
@pytest.mark.parametrize("mode", AutoresetMode)
def test_facts(make: Make, mode: AutoresetMode) -> None:
    env = make(carts(2), autoreset_mode=mode)
    assert env.metadata["autoreset_mode"] is mode
    assert "autoreset_mode" not in env.envs[0].metadata
    assert (env.num_envs, env.get_attr("gravity")) == (2, (9.8, 9.8))


def test_the_arguments_can_be_read() -> None:
    """As ``SyncVectorEnv`` keeps them."""
    env = vector(carts(2), autoreset_mode=AutoresetMode.SAME_STEP)
    assert (env.autoreset_mode, env.copy) == (AutoresetMode.SAME_STEP, True)
    assert env.observation_mode == "same"
    env.close()


@pytest.mark.parametrize(("asked", "other"), [("step", "reset"), ("reset", "step")])
def test_halves_out_of_order(halves: Make, asked: str, other: str) -> None:
    env = halves(carts(3))
    env.reset(seed=0)
    arguments = {"step": (np.zeros(3, np.int64),), "reset": ()}
    with pytest.raises(NoAsyncCallError, match=f"Calling `{asked}_wait` without any prior call"):
        getattr(env, f"{asked}_wait")()
    getattr(env, f"{asked}_async")(*arguments[asked])
    pending = f"while waiting for a pending call to `{asked}` to complete"
    with pytest.raises(AlreadyPendingCallError, match=pending):
        getattr(env, f"{other}_async")(*arguments[other])
    with pytest.warns(UserWarning, match=f"Calling `close` {pending}"):
        env.close()


def test_a_late_reply(halves: Make) -> None:
    """What ``*_wait`` raises is caught as ``multiprocessing``'s error."""
    env = halves([shown(UNIT, slow=20.0)] * 2)
    env.reset_async(seed=0)
    with pytest.raises(multiprocessing.TimeoutError):
        env.reset_wait(timeout=0.01)
    env.close()


@pytest.mark.parametrize("name", ["reset", "step", "close"])
def test_what_is_not_called_by_name(halves: Make, name: str) -> None:
    env = halves(carts(2))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=f"Trying to call function `{name}` with `call`"):
        env.call(name)
    env.close()


def test_somebody_elses_tests_are_run(tmp_path: Path) -> None:
    """The command runs what it is given with Gymnasium's classes replaced, and says what failed."""
    package = tmp_path / "tests"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "test_theirs.py").write_text(THEIRS)
    from tests.compliance.theirs.__main__ import run

    assert run([package], "plain", ["-q", "-k", "replaced"]) == 0
    assert run([package], "plain", ["-q", "-k", "fails"]) == 1


THEIRS = """
import gymnasium as gym
from gymnasium.vector import SyncVectorEnv
from envhub_sandbox import SandboxVectorEnv

class Own(gym.Wrapper):
    pass

def test_replaced():
    env = SyncVectorEnv([lambda: Own(gym.make("CartPole-v1"))] * 2)
    assert isinstance(env, SyncVectorEnv) and isinstance(env, SandboxVectorEnv)
    assert env.reset(seed=0)[0].shape == (2, 4)
    env.close()

def test_fails():
    assert SyncVectorEnv([lambda: gym.make("CartPole-v1")]).num_envs == 2
"""
