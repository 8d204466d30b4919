"""What holds for every test: a cache of its own, and the plugins that all of them run with."""

import fcntl
import gc
import os
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import pytest
from hypothesis import HealthCheck, settings

from envhub_sandbox.system import folders

pytest_plugins = [
    *("tests.hub.fixtures", "tests.support.plugins.selection", "tests.support.plugins.skips"),
    "tests.support.packages.wheels",
]

# A loaded machine is slow at random; what may be slow is bounded by pytest-timeout instead.
# CI tries more examples, and the same ones each time.
_SLOW = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("local", _SLOW, max_examples=25)
settings.register_profile("ci", _SLOW, max_examples=100, derandomize=True)
settings.load_profile("ci" if "ENVHUB_CI" in os.environ else "local")


# A Hub of ours is on this machine, and a loaded one may take longer than ten seconds to answer.
for _name in ("HF_HUB_ETAG_TIMEOUT", "HF_HUB_DOWNLOAD_TIMEOUT"):
    os.environ.setdefault(_name, "60")

# A store is trusted only where nobody else can move it: not in a /tmp that is not sticky.
if folders.why_distrusted(Path(tempfile.gettempdir()), Path("/nowhere")):
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", "/var/tmp")

# Gymnasium colours its warnings also where nobody looks, such as in the summary of a run.
gymnasium.logger.colorize = lambda text, *_, **__: text

# What a shell starts in the background ignores Ctrl-C, and so would every client of our tests.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[object]:
    """The first process of a run compiles the tests; the others wait, and read what it wrote.
    None of them looks for garbage meanwhile: there is none.
    """
    gc.disable()
    tests = os.open(Path(__file__).parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(tests, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        fcntl.flock(tests, fcntl.LOCK_SH)
    try:
        return (yield)
    finally:
        os.close(tests)
        gc.enable()


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """Ten thousand tests stay to the end: no collection of garbage looks through them again.
    And PYTEST_ADDOPTS has been read by all workers: a test that runs pytest has options of its own.
    """
    os.environ.pop("PYTEST_ADDOPTS", None)
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Snapshots and manifests of this run are not the user's, nor an earlier run's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ENVHUB_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def checkout() -> Path:
    """The folder that holds README.md, docs/ and tests/."""
    return Path(__file__).resolve().parent.parent
