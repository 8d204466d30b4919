"""Fixtures for tests that need a Hub; loaded by tests/conftest.py."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.hub.olah_server import OlahServer
from tests.hub.stub_hub import StubHub


def olah_python() -> str:
    """The interpreter that has olah; the test is skipped if there is none."""
    python = os.environ.get("ENVHUB_TEST_OLAH_PYTHON", sys.executable)
    if shutil.which("git") is None:
        pytest.skip("needs git")
    if subprocess.run([python, "-c", "import olah"], capture_output=True, check=False).returncode:
        pytest.skip("needs olah")
    return python


@pytest.fixture(scope="session")
def olah(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OlahServer]:
    """A Hub with real git repositories; give each test's repository a name of its own."""
    server = OlahServer(tmp_path_factory.mktemp("olah"), olah_python())
    yield server
    server.stop()


@pytest.fixture
def stub_hub() -> Iterator[StubHub]:
    """A Hub for one test, which can lie and fail."""
    with StubHub() as stub:
        yield stub


@pytest.fixture
def snapshot_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty store of snapshots (``$ENVHUB_CACHE``), and no token of the developer's.
    Nor is the developer's Hub cache a command's: two runs would wait for each other's locks there.
    """
    store = tmp_path / "envhub-cache"
    monkeypatch.setenv("ENVHUB_CACHE", str(store))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub-of-commands"))
    for name in ("HF_TOKEN", "HUGGING_FACE_HUB_TOKEN", "HF_ENDPOINT", "HF_HUB_OFFLINE"):
        monkeypatch.delenv(name, raising=False)
    return store


@pytest.fixture
def hub_cache(tmp_path: Path, snapshot_store: Path) -> Path:
    """An empty Hub cache (huggingface_hub's ``cache_dir``) beside an empty store."""
    return tmp_path / "hub-cache"
