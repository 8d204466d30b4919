"""Vector environments of a repository's own class, which declare their spaces as they like."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import ActionError, LoadError
from tests.support.compare import assert_same
from tests.support.repositories import write_repository

_OWN = """
import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete

class Own{base}:
    num_envs = 3
    metadata = {{"autoreset_mode": None}}
    {spaces}

    def reset(self, *, seed=None, options=None):
        self.seen = None
        return self._observation(), {{}}

    def _observation(self):
        return {observation}

    def step(self, actions):
        self.seen = actions
        no = np.zeros(3, bool)
        return self._observation(), np.zeros(3), no, no, {{}}

    def got(self):
        return self.seen

    def close(self, **kwargs):
        pass

def make_env(n_envs=1, use_async_envs=False):
    return Own()
"""
_OF_GYMNASIUM = "(gym.vector.VectorEnv)"
_PLAIN = "np.zeros((3, 4), np.float32)"
_LIKE_ARENA = """
    single_observation_space = observation_space = Box(-1, 1, (3, 4))
    single_action_space = action_space = Box(-1, 1, (3, 36))
"""


def own(folder: Path, spaces: str, observation: str = _PLAIN, base: str = _OF_GYMNASIUM) -> Path:
    """A repository around a vector environment with these spaces."""
    return write_repository(
        folder, _OWN.format(base=base, spaces=spaces.strip(), observation=observation)
    )


class TestSpacesThatAreNoBatches:
    """Where a batched space is no batch of the single one, the vector environment's own decides."""

    def test_a_sample_of_the_action_space_is_taken_whole(self, tmp_path: Path) -> None:
        """NVIDIA's wrapper for Isaac Lab Arena gives its action space as the single one, too."""
        with make_env(own(tmp_path, _LIKE_ARENA), n_envs=3) as suites:
            env = suites.env
            assert env.action_space.shape == env.single_action_space.shape == (3, 36)
            env.reset(seed=0)
            for wrong in (np.zeros((3, 3, 36), np.float32), np.zeros((2, 36), np.float32)):
                with pytest.raises(ActionError, match=r"float32 of shape \(3, 36\)"):
                    env.step(wrong)
            assert env.got() is None, "nothing is sent"
            actions = env.action_space.sample()
            observation, *_ = env.step(actions)
            assert observation.shape == (3, 4)
            [seen] = [env.got()]
            assert np.array_equal(seen, actions)
            assert seen.dtype == np.float32

    def test_mappings_of_any_leading_dimension_are_taken(self, tmp_path: Path) -> None:
        """Each leaf has the shape that the vector environment's own space gives it."""
        spaces = """
    observation_space = Box(-1, 1, (3, 4))
    single_action_space = Box(-1, 1, (2,))
    action_space = Dict(robot=Box(-1, 1, (2, 7)), mode=Discrete(4))
"""
        with make_env(own(tmp_path, spaces), n_envs=3) as suites:
            env = suites.env
            env.reset(seed=0)
            actions = env.action_space.sample()
            env.step(actions)
            seen: Any = env.got()
            assert np.array_equal(seen["robot"], actions["robot"])
            assert seen["mode"] == actions["mode"]


_LAZY = """
import gymnasium as gym

class Lazy:
    def __init__(self, fns):
        self._fns, self._env, self.num_envs = fns, None, len(fns)
        env = fns[0]()
        self.observation_space = self.single_observation_space = env.observation_space
        self.action_space = self.single_action_space = env.action_space
        self.metadata = env.metadata
        self.resets = 0

    @property
    def unwrapped(self):
        return self

    def _ensure(self):
        if self._env is None:
            self._env = gym.vector.SyncVectorEnv(self._fns)

    def reset(self, **kwargs):
        self.resets += 1
        self._ensure()
        return self._env.reset(**kwargs)

    def step(self, actions):
        self._ensure()
        return self._env.step(actions)

    def close(self):
        if self._env is not None:
            self._env.close()
            self._env = None

def make_env(n_envs=1, use_async_envs=False):
    names = ["Pendulum-v1", "CartPole-v1", "MountainCarContinuous-v0"]
    lazy = {name: Lazy([lambda name=name: gym.make(name)] * n_envs) for name in names}
    return {"lazy": lazy}
"""


@pytest.mark.parametrize("n_envs", [1, 3])
def test_a_space_of_one_sub_environment_under_both_names(tmp_path: Path, n_envs: int) -> None:
    """LeRobot's lazy vector environment: the first observation tells it from Isaac Lab Arena's."""
    with make_env(write_repository(tmp_path, _LAZY), n_envs=n_envs) as suites:
        resets = [getattr(env, "resets") for env in suites["lazy"].values()]  # noqa: B009
        assert resets == [1, 0, 0], "a suite of them is not started whole"
        for name, env in suites["lazy"].items():
            reference = gym.make_vec(name, n_envs, vectorization_mode="sync")
            assert env.action_space == reference.action_space
            assert env.observation_space == reference.observation_space
            assert_same(reference.reset(seed=1), env.reset(seed=1))
            for _ in range(3):
                actions = reference.action_space.sample()
                assert_same(reference.step(actions), env.step(actions))


_BATCHED = """
    observation_space = Dict(agent_pos=Box(-1, 1, (3, 4)))
    action_space = Box(-1, 1, (3, 2))
"""
_SEEN = '{"agent_pos": np.zeros((3, 4), np.float32)}'


class TestSpacesThatAreMissing:
    """A vector object without a base class and without the spaces of one sub-environment."""

    @pytest.mark.parametrize(
        ("spaces", "observation"),
        [(_BATCHED, _SEEN), ("action_space = Box(-1, 1, (2,))", _SEEN)],
        ids=["batched", "no observation space"],
    )
    def test_they_are_derived_from_the_first_reset(
        self, tmp_path: Path, spaces: str, observation: str
    ) -> None:
        """The observation that it gives shows whether its spaces are batched."""
        with make_env(own(tmp_path, spaces, observation, base=""), n_envs=3) as suites:
            env = suites.env
            assert env.single_observation_space["agent_pos"].shape == (4,)
            assert env.observation_space["agent_pos"].shape == (3, 4)
            assert (env.single_action_space.shape, env.action_space.shape) == ((2,), (3, 2))
            observations, _ = env.reset(seed=0)
            assert observations["agent_pos"].shape == (3, 4)
            env.step(env.action_space.sample())
            assert env.get_attr("seen").shape == (3, 2)

    def test_without_an_action_space_the_error_says_what_to_add(self, tmp_path: Path) -> None:
        folder = own(tmp_path, "observation_space = Box(-1, 1, (3, 4))", base="")
        with pytest.raises(LoadError, match=r"Own.*add single_action_space"):
            make_env(folder, n_envs=3)

    @pytest.mark.parametrize("lacking", ["num_envs", "close"])
    def test_what_is_nearly_a_vector_environment_hears_what_it_lacks(
        self, tmp_path: Path, lacking: str
    ) -> None:
        """``reset`` and ``step`` alone do not say how many sub-environments there are."""
        folder = own(tmp_path, _BATCHED, _SEEN, base="")
        entry = folder / "env.py"
        entry.write_text(entry.read_text().replace(f" {lacking}", f" my_{lacking}"))
        with pytest.raises(LoadError, match=rf"add {lacking}"):
            make_env(folder, n_envs=3)
