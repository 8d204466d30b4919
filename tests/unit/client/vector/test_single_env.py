"""A vector environment of one as a ``gymnasium.Env``: the same episodes as without it."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv

from envhub_sandbox.errors import RemoteProtocolError
from envhub_sandbox.vector.sandbox_view import SandboxView
from envhub_sandbox.vector.single_env import SingleEnv


class _Story(gym.Env[Any, Any]):
    """Counts its steps and its resets, ends every third step, and says so in its infos."""

    observation_space = spaces.Box(0, 1e6, (2,), np.float32)
    action_space = spaces.Discrete(4)

    def __init__(self) -> None:
        self.resets = self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.resets, self.steps = self.resets + 1, 0
        return self._seen(), {"reset": self.resets, "drawn": self.np_random.random()}

    def step(self, action: Any) -> Any:
        self.steps += 1
        info: dict[str, Any] = {"step": self.steps, "deep": {"action": int(action), "word": "up"}}
        if self.steps == 2:
            info["rare"] = np.arange(3)
        return self._seen(), self.steps / 2, self.steps == 3, False, info

    def _seen(self) -> Any:
        return np.array([self.resets, self.steps], np.float32)


class _Echo(gym.Env[Any, Any]):
    """Observes the action."""

    def __init__(self, space: spaces.Space[Any]) -> None:
        self.observation_space = self.action_space = space
        self._last = space.sample()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return self._last, {}

    def step(self, action: Any) -> Any:
        assert action in self.action_space
        return action, 0.0, False, False, {}


class _Recording(_Echo):
    """Notes the classes of its actions."""

    def step(self, action: Any) -> Any:
        return (*super().step(np.asarray(action))[:4], {"kind": type(action).__name__})


def test_a_list_of_numbers_arrives_as_one() -> None:
    """As in a vector environment, whose action is a list of them."""
    env = SingleEnv(SyncVectorEnv([lambda: _Recording(spaces.Box(-1, 1, (2,), np.float64))]))
    env.reset()
    actions = [0.5, 1.0], np.array([0.5, 1.0])
    assert [env.step(action)[4]["kind"] for action in actions] == ["list", "ndarray"]


def test_keys_of_an_action_in_another_order_are_told() -> None:
    """The environment gets them in its own, since it may go by their order."""
    space = spaces.Dict(left=spaces.Discrete(2), right=spaces.Discrete(2))
    env = SingleEnv(SyncVectorEnv([lambda: _Echo(space)]))
    env.reset()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        env.step({"left": 0, "right": 1})
        assert not told
        seen = [list(env.step({"right": 1, "left": 0})[0]) for _ in range(2)]
    assert seen == [["left", "right"]] * 2
    assert ["['right', 'left']" in str(each.message) for each in told] == [True]


class _Boasting(_Story):
    """Has an attribute that is the client's name for the sandbox."""

    sandbox = "the best"


def test_its_sandbox_is_never_the_environments_own_word() -> None:
    """Where there is none, an environment that says so is not asked."""
    vector = SyncVectorEnv([_Boasting])
    with pytest.raises(AttributeError, match="sandbox"):
        _ = SingleEnv(vector).sandbox
    vector.sandbox = "the best"
    assert not hasattr(SingleEnv(vector), "sandbox")
    vector.sandbox = view = SandboxView(None)
    assert SingleEnv(vector).sandbox is gym.Wrapper(SingleEnv(vector)).unwrapped.sandbox is view


def test_a_batch_of_two_is_refused() -> None:
    with pytest.raises(ValueError, match="n_envs=1"):
        SingleEnv(SyncVectorEnv([_Story, _Story]))


class _Liar(VectorEnv[Any, Any, Any]):
    """A repository's own class, which returns what the test wants."""

    num_envs = 1
    observation_space = single_observation_space = spaces.Discrete(2)
    action_space = single_action_space = spaces.Discrete(2)

    def __init__(self, **lies: Any) -> None:
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self.said = {"observation": np.zeros(1), "rewards": np.zeros(1), "infos": {}}
        self.said |= {"terminations": np.zeros(1, bool), "truncations": np.zeros(1, bool)} | lies

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return self.said["observation"], self.said["infos"]

    def step(self, actions: Any) -> Any:
        names = ("observation", "rewards", "terminations", "truncations", "infos")
        return tuple(self.said[name] for name in names)


@pytest.mark.parametrize(
    "lies",
    [
        {"terminations": np.ones(1, bool)},
        {"terminations": np.ones((1, 2), bool)},
        {"infos": {"a": np.ones(1), "_a": np.zeros(0, bool)}},
        {"infos": {"a": 1, "_a": np.ones((1, 2), object)}, "observation": ()},
    ],
    ids=str,
)
def test_results_that_are_of_nobody_break_the_rules(lies: Any) -> None:
    env = SingleEnv(_Liar(**lies))
    with pytest.raises(RemoteProtocolError):
        env.step(1)
    if "infos" in lies:
        with pytest.raises(RemoteProtocolError):
            env.reset()


@pytest.mark.parametrize("metadata", [{}, {"autoreset_mode": AutoresetMode.SAME_STEP}], ids=str)
def test_an_own_class_that_has_begun_again_shows_the_last_observation(metadata: Any) -> None:
    """Also one that says so by its ``final_obs`` alone; the next reset is the one it has made."""
    vector = _Liar(terminations=np.ones(1, bool), infos={"final_obs": np.ones(1)})
    vector.metadata, vector.observation_space = metadata, spaces.MultiDiscrete([2])
    env = SingleEnv(vector)
    observation, _, terminated, _, info = env.step(1)
    assert (observation, terminated, info) == (1, True, {})
    assert env.reset() == (0, {})
    vector.said["infos"] = {}
    if metadata:
        with pytest.raises(RemoteProtocolError, match="no final_obs"):
            env.step(1)


@pytest.mark.parametrize(("found", "seed"), [(None, -1), ((None,), -1), ((3,), 3), (3, 3)])
def test_unknown_seed_is_minus_one(monkeypatch: pytest.MonkeyPatch, found: Any, seed: int) -> None:
    """As ``gymnasium.Env`` has it."""
    monkeypatch.setattr(_Liar, "np_random_seed", found)
    assert SingleEnv(_Liar()).np_random_seed == seed
