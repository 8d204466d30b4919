"""One worker server for all cells of a test process, with a neighbour in it that must go on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox import make_env
from tests.faults.traces import Traces, temporary_root
from tests.support.processes import eventually
from tests.support.samples import sample


@dataclass
class Neighbour:
    """An environment of another jail of the same server, which counts its steps."""

    env: Any
    steps: int = 0

    def goes_on(self) -> bool:
        """Whether its next step is the one after the last."""
        self.steps += 1
        return bool(self.env.step([0])[0].tolist() == [[float(self.steps)]])


@pytest.fixture(scope="session")
def place() -> Iterator[Path]:
    """Where every temporary file of ours lies; nothing is left in it, or of it, at the end."""
    with temporary_root() as folder:
        yield folder
        gone = eventually(lambda: _only_ours(folder))
        assert gone, Traces.of(folder).beyond(Traces())


def _only_ours(folder: Path) -> bool:
    found = Traces.of(folder)
    return not (found.processes or found.files or found.sockets or found.mounts or found.cgroups)


@pytest.fixture(scope="session")
def neighbour(place: Path) -> Iterator[Neighbour]:
    """Keeps the server, and is there to be disturbed."""
    with make_env(sample("faulty")) as suites:
        suites.env.reset()
        yield Neighbour(suites.env)
