"""One server for tests that leave it as it was."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.remote.listening import Listening, counting, listening


@pytest.fixture(scope="package")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Listening]:
    """A server on loopback, with keys."""
    with listening(tmp_path_factory.mktemp("server"), "--idle-s", "2") as found:
        yield found


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A repository whose action says how long a step takes."""
    return counting(tmp_path / "repository")
