"""One cluster of two nodes for all tests of this folder that leave it as it was."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.remote.ray.clusters import cluster_of

TIMEOUT_S = 900
"""The first test waits for the cluster, too."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.timeout(TIMEOUT_S))


@pytest.fixture(autouse=True)
def _patient() -> None:
    """Here servers are killed: how soon one counts as gone is as for a user."""


@pytest.fixture(scope="package")
def cluster() -> Iterator[Any]:
    """This process is connected to it. Each node has two CPUs and a resource of its own."""
    ray = pytest.importorskip("ray")
    with cluster_of({"one": 8}, {"two": 8}) as found:
        ray.init(address=found.address, log_to_driver=False)
        try:
            yield found
        finally:
            ray.shutdown()
