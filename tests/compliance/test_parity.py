"""The samples that have a ``SyncVectorEnv`` to be compared with, against the suite."""

from pathlib import Path

import numpy as np
import pytest
from gymnasium.error import CustomSpaceError
from gymnasium.vector import AutoresetMode

from envhub_sandbox import make_env
from tests.compliance.pair import Pair
from tests.compliance.vector_env import Case, VectorEnvCompliance, cases, each_mode
from tests.support import inside
from tests.support.compare import assert_same
from tests.support.repositories import STILL, write_repository


class TestCounter(VectorEnvCompliance):
    """Every kind of value in the infos, episodes of two to six steps."""

    sample = "counter"
    cases = [Case(1, False, {"autoreset_mode": "NextStep"}), *cases()]  # noqa: RUF012
    steps = 150
    over_frames = 3

    def test_options_reach_the_sub_environments(self, pair: Pair) -> None:
        for options in (None, {}, {"level": 3, "names": ["a", "b"], "deep": {"x": (1, 2.5)}}):
            pair.reset(seed=1, options=options)

    def test_methods_take_arguments(self, pair: Pair) -> None:
        for args, kwargs in (((1,), {}), ((1, 2), {}), ((1,), {"b": 5})):
            expected = pair.reference.call("add", *args, **kwargs)
            assert_same(expected, pair.sandboxed.call("add", *args, **kwargs), "call")
        pair.sandboxed.call_async("add", 4)
        assert_same(pair.reference.call("add", 4), pair.sandboxed.call_wait(), "call_wait")

    def test_get_attr_calls_what_can_be_called(self, pair: Pair) -> None:
        pair.reset(seed=2)
        assert_same(pair.reference.get_attr("render"), pair.sandboxed.get_attr("render"))

    def test_exceptions_keep_their_builtin_class(self, pair: Pair) -> None:
        pair.reset(seed=3)
        with pytest.raises(ValueError, match="counter 0 failed"):
            pair.sandboxed.call("fail")
        with pytest.raises(NotImplementedError):
            pair.sandboxed.call("not_here")
        with pytest.raises(TypeError):
            pair.sandboxed.call("add")
        pair.step(pair.sample_actions(3, 1)[0])

    def test_frames(self, pair: Pair) -> None:
        pair.reset(seed=4)
        pair.step(pair.sample_actions(4, 1)[0])
        assert_same(pair.reference.render(), pair.sandboxed.render(), "render")
        assert_same(pair.reference.call("render"), pair.sandboxed.call("render"), "call")

    def test_attribute_changes_the_environment(self, pair: Pair) -> None:
        for env in (pair.reference, pair.sandboxed):
            env.set_attr("gain", [0.5 + i for i in range(pair.num_envs)])
        pair.drive(seed=5, steps=10)
        for env in (pair.reference, pair.sandboxed):
            env.set_attr("gain", 1.0)

    def test_stepping_what_has_ended(self, pair: Pair) -> None:
        """With autoreset disabled a step after the end is an AssertionError, until a reset."""
        if pair.autoreset_mode is not AutoresetMode.DISABLED:
            return
        pair.reset(seed=6)
        for actions in pair.sample_actions(6, 7):
            *_, terminations, truncations, _ = pair.step(actions)
            if np.logical_or(terminations, truncations).any():
                break
        for env in (pair.reference, pair.sandboxed):
            with pytest.raises(AssertionError):
                env.step(pair.sample_actions(6, 1)[0])
        pair.drive(seed=6, steps=5)

    def test_actions_of_every_kind(self, pair: Pair) -> None:
        pair.reset(seed=7)
        numbers = [i % 3 for i in range(pair.num_envs)]
        kinds = [numbers, tuple(numbers), np.array(numbers), np.array(numbers, np.int32)]
        for actions in kinds:
            if pair.autoreset_mode is AutoresetMode.DISABLED:
                pair.reset(seed=7)
            pair.step(actions)


@pytest.mark.short
class TestCounterInUnevenShards(VectorEnvCompliance):
    """Four sub-environments over three processes."""

    sample = "counter"
    cases = cases(n_envs=(4,), use_async_envs=(True,), async_workers=3)
    steps = 100


@pytest.mark.short
class TestCartPole(VectorEnvCompliance):
    """Discrete actions, float32 observations, dozens of ended episodes."""

    sample = "cartpole"
    cases = each_mode(4)
    steps = 250

    def test_lane_is_the_one_that_was_asked_for(self, pair: Pair, lane: str) -> None:
        pair.reset(seed=1)
        in_use = inside.lane(pair.sandboxed) is not None
        assert in_use is (lane == "auto")


class TestPendulum(VectorEnvCompliance):
    """Continuous actions, truncation."""

    sample = "pendulum"
    cases = cases((1,), (False,), ("NextStep",)) + cases((3,), (True,), ("SameStep",))
    steps = 200

    def test_actions_keep_their_precision(self, pair: Pair) -> None:
        """float64 and integer actions reach a float32 Box as they are, as in Gymnasium."""
        pair.reset(seed=1)
        shape = pair.reference.action_space.shape
        pair.step(np.full(shape, 1 / 3))
        pair.step(np.ones(shape, np.int64))
        pair.step([[1 / 3]] * pair.num_envs)


class TestLeRobotPendulum(VectorEnvCompliance):
    """Dict observations and ``is_success`` in every info."""

    sample = "lerobot_pendulum"
    cases = each_mode(2)


class TestExoticSpaces(VectorEnvCompliance):
    """Spaces that have no fixed layout, for observations and actions."""

    sample = "exotic_spaces"
    cases = [*cases((1,), (False,), ("NextStep",)), *each_mode(3)]  # noqa: RUF012
    steps = 60


class TestMiniGrid(VectorEnvCompliance):
    """A custom space in the observation."""

    sample = "minigrid"
    cases = each_mode(2)[::2]
    steps = 60

    def test_spaces_are_equal(self, pair: Pair) -> None:
        expected = pair.reference.single_observation_space
        actual = pair.sandboxed.single_observation_space
        assert list(actual) == list(expected)
        assert {key: actual[key] for key in ("direction", "image")} == {
            key: expected[key] for key in ("direction", "image")
        }
        assert "MissionSpace" in repr(actual["mission"])
        with pytest.raises(CustomSpaceError, match="MissionSpace"):
            actual["mission"].sample()


class TestLunarLander(VectorEnvCompliance):
    """A native physics engine."""

    sample = "lunar_lander"
    cases = cases((2,), (True,), ("NextStep",))


class TestHalfCheetah(VectorEnvCompliance):
    """MuJoCo, float64 observations, flat infos in every step."""

    sample = "half_cheetah"
    cases = each_mode(2)[::2]
    steps = 100


class TestPushT(VectorEnvCompliance):
    """Pixels and a state in a dict."""

    sample = "pusht"
    cases = each_mode(2)[::2]
    steps = 45


class TestMultiObjective(VectorEnvCompliance):
    """Vector rewards, from a subclass of ``SyncVectorEnv`` with a ``step`` of its own."""

    sample = "mo_gymnasium"
    cases = [Case(3)]  # noqa: RUF012
    steps = 60


@pytest.mark.parametrize("lane", ["auto", "frames"])
def test_a_space_of_another_byte_order_has_the_same_values(lane: str, tmp_path: Path) -> None:
    """They arrive in native byte order, as the space does."""
    foreign = """
class Foreign(Still):
    observation_space = gym.spaces.Box(-9, 9, (2,), np.dtype(">f4"))

    def reset(self, **options):
        return np.array([1, 2], ">f4"), {}

    def step(self, action):
        return np.array([3, 4]), 0.0, False, False, {}
"""
    folder = write_repository(tmp_path, STILL + foreign)
    with make_env(folder, 2, policy={"lane": lane}) as suites:
        assert_same(np.array([[1, 2]] * 2, np.float32), suites.env.reset()[0])
        assert_same(np.array([[3, 4]] * 2, np.float32), suites.env.step([0, 1])[0])
