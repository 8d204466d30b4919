"""One environment of a repository as an ordinary ``gymnasium.Env``."""

from __future__ import annotations

import copy
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from envhub_sandbox import SandboxEnv
from tests.support.samples import EXAMPLES

pytestmark = pytest.mark.same_for("users")

_ID = "envhub_sandbox.integrations.gym:Hub-v0"


@pytest.fixture(autouse=True)
def _quiet() -> None:
    warnings.filterwarnings("ignore", module="gymnasium.*")


def test_gymnasiums_own_check_passes() -> None:
    """As for an environment that its author wrote here."""
    env = SandboxEnv(EXAMPLES / "cartpole")
    try:
        check_env(env)
    finally:
        env.close()


def test_episodes_are_those_of_the_environment_in_this_process() -> None:
    """Bit for bit, several episodes; and its copy plays the same ones."""
    env, reference = SandboxEnv(EXAMPLES / "cartpole"), gym.make("CartPole-v1")
    twin = copy.deepcopy(env)
    try:
        for one in (env, twin):
            seen, expected = one.reset(seed=3), reference.reset(seed=3)
            for step in range(60):
                assert np.array_equal(seen[0], expected[0])
                assert seen[1:] == expected[1:]
                seen, expected = one.step(step % 3 % 2), reference.step(step % 3 % 2)
                if expected[2]:
                    assert seen[1:4] == expected[1:4]
                    seen, expected = one.reset(), reference.reset()
    finally:
        env.close()
        twin.close()


def test_gymnasium_makes_it_by_its_id() -> None:
    """One and several, with what make_env takes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = gym.make(_ID, ref=str(EXAMPLES / "cartpole"), limits={"processes": 32})
        assert isinstance(env.unwrapped, SandboxEnv)
        assert env.reset(seed=1)[0] in env.observation_space
        env.close()
        env.close()
        envs = gym.make_vec(_ID, num_envs=3, ref=str(EXAMPLES / "cartpole"))
        assert envs.reset(seed=1)[0].shape == (3, 4)
        envs.close()


def test_a_task_is_chosen_by_name() -> None:
    """One of several must be named; what there is, the error says."""
    with pytest.raises(ValueError, match=r"\['maze'\]\[0\], \['maze'\]\[1\]"):
        SandboxEnv(EXAMPLES / "two_tasks")
    with pytest.raises(ValueError, match=r"no suite 'house'.*there are: \['maze'\]\[0\]"):
        SandboxEnv(EXAMPLES / "two_tasks", suite="house")
    env = SandboxEnv(EXAMPLES / "two_tasks", task=1)
    env.reset(seed=0)
    assert env.step(env.action_space.sample())[0] in env.observation_space
    env.close()
    assert env.vector.closed


def test_a_notebook_shows_its_spaces() -> None:
    """Those of the environment that it is the only one of; its text is the client's."""
    html = "_repr_html_"
    env = SandboxEnv(EXAMPLES / "cartpole")
    try:
        assert "Discrete(2)" in getattr(env, html)()
    finally:
        env.close()
