"""What the tests of containers share: an engine with the image, or a reason to skip.

``ENVHUB_TEST_IMAGE`` names the image; ``envhub-worker`` by default, which must be built from this
checkout: ``docker build -t envhub-worker .``. With
``ENVHUB_CONTAINER_TABLE=docs/attacks-containers.md`` a run as root writes the table of attacks.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from envhub_sandbox.errors import SandboxUnavailableError
from envhub_sandbox.sandboxes.docker.engines import Engine, find_engine, find_image
from envhub_sandbox.sandboxes.docker.sandbox import DockerSandbox
from tests.attacks import table
from tests.attacks.harness import USER
from tests.compliance.conftest import lane, pytest_generate_tests
from tests.containers.kit import IMAGE, Walls

__all__ = ["lane", "pytest_generate_tests"]

PLACES = ("strict-jail", "bare-jail", "walls")
_COLUMNS = ("control, root", *(f"{place}, root" for place in PLACES))
_HEAD = """# Attacks in containers

Written by `tests/containers` (`ENVHUB_CONTAINER_TABLE=docs/attacks-containers.md pytest
tests/containers`, as root); do not edit by hand. The words are those of [attacks.md](attacks.md):
the control runs without a container, in the same test, and has to succeed.

- **strict-jail**: in a jail with namespaces, in a container: what `sandbox="docker"` gives.
- **bare-jail**: in a jail without, in a container: where namespaces cannot be had inside.
- **walls**: in no jail at all, next to the server, should a jail be broken.
"""
_TABLE = table.Collected("container attack", "ENVHUB_CONTAINER_TABLE", _COLUMNS, _HEAD)


@pytest.fixture(scope="session", autouse=True)
def engine() -> Engine:
    """The engine, which has the image."""
    try:
        found = find_engine(os.environ.get("ENVHUB_TEST_ENGINE"))
        find_image(found, IMAGE)
    except SandboxUnavailableError as error:
        pytest.skip(f"needs a container engine and the image {IMAGE}: {error}")
    return found


@pytest.fixture(scope="session")
def docker(engine: Engine) -> DockerSandbox:
    """Containers of the image under test."""
    return DockerSandbox(image=IMAGE, engine=engine.kind)


@pytest.fixture
def open_ground() -> Iterator[Path]:
    """A folder that every user may write. File modes shall not be what stops an attack."""
    folder = Path(tempfile.mkdtemp(prefix="envhub-ground-"))
    folder.chmod(0o777)
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(params=PLACES)
def walls(request: pytest.FixtureRequest, engine: Engine) -> Iterator[Walls]:
    """Where an attack is tried."""
    made = Walls(request.param, engine)
    yield made
    _TABLE.found(request.node, made.rows)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Collect the rows."""
    _TABLE.read(report)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Write the table, if asked to; it has columns for root only."""
    if USER == "root":
        _TABLE.write(session)
