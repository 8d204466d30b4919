"""A liar, and a repository that nobody ever reads."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.attacks.client.lying_server import LyingServer, lying
from tests.support.repositories import write_repository


@pytest.fixture
def liar() -> Iterator[LyingServer]:
    with lying() as server:
        yield server


@pytest.fixture
def folder(tmp_path: Path) -> str:
    """A repository; nothing reads it. Each is another one, so nothing is cached."""
    return str(write_repository(tmp_path / "repository", f"# {tmp_path}"))
