"""One environment of a repository as an ordinary ``gymnasium.Env``."""

from __future__ import annotations

import contextlib
import copy
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from envhub_sandbox import SandboxEnv
from envhub_sandbox.errors import LoadError
from tests.support.samples import EXAMPLES

pytestmark = pytest.mark.same_for("users")

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
