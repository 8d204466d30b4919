"""Servers for tests that leave them as they were."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.remote.listening import Listening, counting, listening
from tests.support import inside
from tests.support.started import started

IMPATIENT_S = 8


@pytest.fixture(autouse=True)
def _patient() -> Iterator[None]:
    """Who is slow is not gone: a loaded machine takes the core from a server for a long time.
    A test of how soon a server counts as gone says by itself how soon."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("envhub_sandbox.extras.remote.tcp.CONNECT_S", 60.0)
        for spot in (*inside.WAITS_FOR_A_SERVER, inside.WAIT_FOR_OUTPUT):
            patch.setattr(*spot, 60.0)
        yield


@pytest.fixture(scope="package")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Listening]:
    """A server on loopback, with keys; as patient as by default."""
    with listening(tmp_path_factory.mktemp("server")) as found:
        yield found


@pytest.fixture(scope="package")
def impatient(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Listening]:
    """One that soon ends what belongs to a silent client: later than a loaded machine is silent."""
    folder = tmp_path_factory.mktemp("impatient")
    with listening(folder, "--idle-s", str(IMPATIENT_S)) as found:
        yield found


@pytest.fixture
def wait_no_more(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Once a server has ended: nobody waits for its word, or for it to come back."""

    def hurry() -> None:
        for spot in inside.WAITS_FOR_A_SERVER:
            monkeypatch.setattr(*spot, 0.1)
        monkeypatch.setattr("envhub_sandbox.extras.remote.tcp.CONNECT_S", 0.5)

    return hurry


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A repository whose action says how long a step takes."""
    return counting(tmp_path / "repository")


@pytest.fixture
def good(server: Listening, repository: Path) -> Iterator[Any]:
    """A client's environment, which must go on; afterwards it is still the same one."""
    with started(repository, sandbox=server.sandbox()) as env:
        yield env
        assert env.step(np.array([0]))[0].tolist() == [[1.0]]
