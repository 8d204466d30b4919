"""What the tests of containers share: an engine with the image, or a reason to skip.

``ENVHUB_TEST_IMAGE`` names the image; ``envhub-worker`` by default, which must be built from this
checkout: ``docker build -t envhub-worker .``
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from envhub_sandbox.errors import SandboxUnavailableError
from envhub_sandbox.sandboxes.docker import DockerSandbox
from envhub_sandbox.sandboxes.engines import Engine, find_engine, find_image
from tests.compliance.conftest import lane, pytest_generate_tests
from tests.containers.kit import IMAGE

__all__ = ["lane", "pytest_generate_tests"]


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
