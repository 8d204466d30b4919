"""Servers on loopback, each with keys of its own, and a repository whose rows say who they are."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.remote.listening import Listening, listening, worker
from tests.support.processes import eventually
from tests.support.repositories import write_repository

ROWS = """
import os, signal, time
import gymnasium as gym
import numpy as np

class Row(gym.Env):
    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = gym.spaces.Discrete(100)

    def __init__(self, index):
        self.index, self.gain = index, 1.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return self.seen(), {"row": self.index}

    def step(self, action):
        if action == 99:
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(int(action) / 100)
        self.count += 1
        return self.seen(), self.gain, False, False, {"row": self.index}

    def seen(self):
        return np.array([self.index, self.count, self.np_random.random()])

    def pid(self):
        return os.getpid()

def make_env(n_envs=1, use_async_envs=False):
    return gym.vector.SyncVectorEnv([lambda i=i: Row(i) for i in range(n_envs)])
"""
DIES = 99
"""The action with which a row's process ends; any other is so many hundredths of a second."""


@pytest.fixture(scope="session")
def rows(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Observations are the row, its steps, and a number that its seed decides."""
    return write_repository(tmp_path_factory.mktemp("rows"), ROWS)


@pytest.fixture(scope="session")
def client_key(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The secret key of one client, whom all servers know; beside it lies the public one."""
    folder = tmp_path_factory.mktemp("client")
    assert worker("keygen", "--out", folder).returncode == 0
    return folder / "client.key"


@contextmanager
def serving(folder: Path, client: Path, *options: str, **more: Any) -> Iterator[Listening]:
    known = ("--authorized-clients", str(client.with_suffix(".pub")))
    with listening(folder, *known, *options, **more) as server:
        server.client_key = str(client)
        yield server


@pytest.fixture(scope="package")
def servers(
    tmp_path_factory: pytest.TempPathFactory, client_key: Path
) -> Iterator[list[Listening]]:
    with ExitStack() as stack:
        folders = [tmp_path_factory.mktemp(f"server{number}") for number in range(3)]
        yield [stack.enter_context(serving(folder, client_key)) for folder in folders]


@pytest.fixture
def stays(servers: list[Listening]) -> Listening:
    """One of them, with nothing of an earlier test's in it; for a fleet of which another goes."""
    assert eventually(lambda: servers[0].jails() == 0)
    return servers[0]


@pytest.fixture
def serve(tmp_path: Path, client_key: Path) -> Iterator[Callable[..., Listening]]:
    with ExitStack() as stack:

        def start(name: str, *options: str, **more: Any) -> Listening:
            return stack.enter_context(serving(tmp_path / name, client_key, *options, **more))

        yield start


def places(env: Any) -> list[str]:
    return [worker["place"] for worker in env.sandbox.stats()["workers"]]
