"""What a repository declares, on each place of a fleet as that place makes it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from envhub_sandbox import make_env
from envhub_sandbox.errors import MissingModuleError
from tests.integration.fleet.conftest import places, serving
from tests.remote.listening import Listening
from tests.support.packages.wheels import Index, make_wheel
from tests.support.ports import lasting_port
from tests.support.repositories import write_repository

ENV = """
import gymnasium as gym
import listed

class Told(gym.Wrapper):
    def where(self):
        return listed.__file__

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([lambda: Told(gym.make("CartPole-v1"))] * n_envs)
"""


@pytest.fixture(scope="module")
def packages(real_index: Index) -> Index:
    """An index with a package that is installed nowhere."""
    make_wheel(real_index.folder, "listed", "1.0")
    return real_index


def test_here_and_on_a_server(packages: Index, client_key: Path, tmp_path: Path) -> None:
    """Each place makes them itself; the results are those of one."""
    folder = write_repository(tmp_path / "repository", ENV, requirements__txt="listed\n")
    with make_env(folder, n_envs=4) as suites:
        expected = suites.env.reset(seed=3)[0]
    with (
        serving(tmp_path / "server", client_key, "--dependencies") as server,
        make_env(folder, n_envs=4, sandbox=["process", server.sandbox()]) as suites,
    ):
        assert np.array_equal(suites.env.reset(seed=3)[0], expected)
        assert sorted(places(suites.env)) == sorted(["process", server.endpoint])
        where = suites.env.call("where")
        assert len(set(where)) == 2
        assert "listed==1.0" in suites.provenance["installed"]["packages"]


def test_a_server_that_is_not_there_keeps_no_other_from_making_them(
    packages: Index, servers: list[Listening], tmp_path: Path
) -> None:
    """All workers go where there are some; the absent server gets none."""
    folder = write_repository(tmp_path / "repository", ENV, requirements__txt="listed\n")
    absent = servers[0].sandbox(endpoint=f"tcp://127.0.0.1:{lasting_port()}")
    with make_env(folder, n_envs=2, sandbox=[absent, "process"]) as suites:
        suites.env.reset()
        assert places(suites.env) == ["process", "process"]


def test_a_place_that_lacks_one(packages: Index, client_key: Path, tmp_path: Path) -> None:
    """A server that makes none has its own packages: the error says which rows and which place."""
    folder = write_repository(tmp_path / "repository", ENV, requirements__txt="listed\n")
    with (
        serving(tmp_path / "server", client_key) as server,
        make_env(folder, n_envs=4, sandbox=["process", server.sandbox()]) as suites,
        pytest.raises(MissingModuleError, match="No module named 'listed'") as caught,
    ):
        suites.env.reset()
    assert f"of 4, on {server.endpoint}" in str(caught.value)
