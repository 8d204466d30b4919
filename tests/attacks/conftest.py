"""Fixtures of the attacks, and the table that a run of them writes.
``ENVHUB_ATTACK_TABLE=attacks.md pytest tests/attacks`` writes this user's columns of the
table; run it as root and as a plain user for all of them."""

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from envhub_sandbox.sandboxes.process import PROCESS
from envhub_sandbox.system.folders import cache_root
from tests.attacks import table
from tests.attacks.harness import Arena, LastingJail, OpenJail
from tests.support.interpreter import profiles
from tests.support.turns import turn

_TABLE = table.Collected("attack", "ENVHUB_ATTACK_TABLE")


@pytest.fixture(scope="package")
def open_ground() -> Iterator[Path]:
    """A folder that every user may enter. File modes shall not be what stops an attack."""
    folder = Path(tempfile.mkdtemp(prefix="envhub-attacks-"))
    folder.chmod(0o755)
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="package", autouse=True)
def warm_server(_own_cache: None, open_ground: Path) -> Iterator[None]:
    """One worker server for all tests in a row: its zygotes stay warm between them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ENVHUB_CACHE", str(open_ground / "cache"))
        use = PROCESS.acquire(cache_root() / "snapshots")
        yield
        use.release()


@pytest.fixture
def home(open_ground: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A home of the caller's, outside of every snapshot, that everybody may enter and write."""
    folder = Path(tempfile.mkdtemp(prefix="home-", dir=open_ground))
    folder.chmod(0o777)
    monkeypatch.setenv("HOME", str(folder))
    return folder


@pytest.fixture
def other_cache(open_ground: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Another store, and so another worker server. Not in a home that everybody may write."""
    folder = Path(tempfile.mkdtemp(prefix="cache-", dir=open_ground))
    folder.chmod(0o755)
    monkeypatch.setenv("ENVHUB_CACHE", str(folder))
    return folder


@pytest.fixture(params=profiles("strict", "no-userns"))
def arena(request: pytest.FixtureRequest) -> Iterator[Arena]:
    made = Arena(request.param, request.node.module.FAMILY)
    yield made
    _TABLE.found(request.node, made.rows)


@pytest.fixture(params=profiles("strict"))
def strict(request: pytest.FixtureRequest) -> Iterator[Arena]:
    """The same for one profile: what only that one has, or what a client makes of a jail."""
    made = Arena(request.param, request.node.module.FAMILY)
    yield made
    _TABLE.found(request.node, made.rows)


@pytest.fixture(scope="module", params=profiles("strict", "no-userns"))
def lasting(warm_server: None, request: pytest.FixtureRequest) -> Iterator[LastingJail]:
    made = LastingJail(request.param)
    yield made
    made.close()


@pytest.fixture
def jail(lasting: LastingJail, request: pytest.FixtureRequest) -> Iterator[OpenJail]:
    """Where a test attacks that leaves its jail for the next one, once for each profile."""
    made = lasting.open(request.node.module.FAMILY)
    yield made
    _TABLE.found(request.node, made.arena.rows)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    _TABLE.read(report)


def pytest_sessionfinish(session: pytest.Session) -> None:
    _TABLE.write(session)


@pytest.fixture
def broadcasting() -> Iterator[None]:
    """What is sent to everybody is sent by one test at a time, whichever process runs it."""
    with turn("broadcasting"):
        yield
