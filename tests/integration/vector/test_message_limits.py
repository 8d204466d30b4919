"""``limits={"message_bytes": ...}`` holds at both ends, and errors name the limit to raise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import RemoteEnvError, RemoteProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS, limits_for
from tests.support.repositories import write_repository

_ENV = """
import gymnasium as gym
import numpy as np

class Large(gym.Env):
    observation_space = gym.spaces.Box(0, 255, (SIZE,), np.uint8)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        return np.zeros(SIZE, np.uint8), {}

    def step(self, action):
        return np.zeros(SIZE, np.uint8), 0.0, False, False, {"large": [np.zeros(3 << 20, np.uint8)]}

    def large(self, size):
        return np.zeros(size, np.uint8)

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([Large] * n_envs)
"""


def _repository(folder: Path, size: int) -> Path:
    return write_repository(folder, _ENV.replace("SIZE", str(size)))


@pytest.mark.parametrize("lane", ["auto", "frames"])
def test_a_smaller_limit_is_the_jails_own(tmp_path: Path, lane: str) -> None:
    """What is larger is an error of that call; the environment goes on."""
    folder = _repository(tmp_path, 4)
    with make_env(folder, lane=lane, limits={"message_bytes": 1 << 20}) as suites:
        env = suites.env
        env.reset()
        with pytest.raises(RemoteEnvError, match=r"1048576 \(message_bytes\)"):
            env.call("large", 2 << 20)
        assert "RemoteObject" in repr(type(env.step(np.array([0]))[4]["large"][0][0]))
        assert len(env.call("large", 1 << 19)[0]) == 1 << 19


def test_a_larger_limit_lets_more_through(tmp_path: Path) -> None:
    """More than the default, which the server's own reader has as well."""
    size = DEFAULT_LIMITS.message_bytes + 1
    assert limits_for(2 * size) is limits_for(2 * size)
    with make_env(_repository(tmp_path, 4), limits={"message_bytes": 2 * size}) as suites:
        assert len(suites.env.call("large", size)[0]) == size


def test_a_large_space_names_the_limit(tmp_path: Path) -> None:
    """And is made with a higher one."""
    folder = _repository(tmp_path, 100 << 10)
    with pytest.raises(RemoteProtocolError, match=r"raise the limit.*elements"):
        make_env(folder, limits={"elements": 10_000}).close()
    make_env(folder, limits={"elements": 1_000_000}).close()
