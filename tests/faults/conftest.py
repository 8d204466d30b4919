"""One worker server for all cells in a row, with a neighbour in it that must go on."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.sandboxes.pool import stop_idle
from tests.faults.remains.traces import Traces, temporary_root
from tests.support import inside
from tests.support.processes import eventually
from tests.support.samples import sample
from tests.support.started import started


@dataclass
class Neighbour:
    """An environment of another jail of the same server, which counts its steps."""

    env: Any
    steps: int = 0

    def goes_on(self) -> bool:
        """Whether its next step is the one after the last."""
        self.steps += 1
        return bool(self.env.step([0])[0].tolist() == [[float(self.steps)]])


@pytest.fixture(scope="package")
def place() -> Iterator[Path]:
    """Where every temporary file of ours lies; nothing is left in it, or of it, at the end."""
    with temporary_root() as folder:
        before = Traces.of(folder)
        yield folder
        stop_idle()  # servers that linger; they are all that a closed environment leaves
        gone = eventually(lambda: not _left(folder, before))
        assert gone, _left(folder, before)


@pytest.fixture(scope="package", autouse=True)
def _patient() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(*inside.WAIT_FOR_OUTPUT, 60.0)
        patch.setattr(*inside.WAITS_FOR_A_SERVER[0], 60.0)
        yield


def _left(folder: Path, before: Traces) -> list[str]:
    """What is there now, but for descriptors: this process has some of its own."""
    found = replace(Traces.of(folder), descriptors=Counter())
    return found.beyond(before)


@pytest.fixture(scope="package")
def neighbour(place: Path) -> Iterator[Neighbour]:
    with started(sample("faulty"), seed=None) as env:
        yield Neighbour(env)
