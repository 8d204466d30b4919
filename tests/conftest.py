"""What holds for every test: a cache of its own, and in CI no silent skip."""

from __future__ import annotations

import os
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from envhub_sandbox import folders

pytest_plugins = ["tests.hub.fixtures"]

# Reasons for which a test may be skipped in CI, each with the variable that permits it there.
_PERMITTED = {
    "'torch'": "ENVHUB_CI_WITHOUT_TORCH",
    "needs torch": "ENVHUB_CI_WITHOUT_TORCH",
    "may not make control groups": "ENVHUB_CI_WITHOUT_CGROUPS",
}

# A loaded machine is slow at random; what may be slow is bounded by pytest-timeout instead.
settings.register_profile("local", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("ci", settings.get_profile("local"), derandomize=True)
settings.load_profile("ci" if "ENVHUB_CI" in os.environ else "local")


# A store is trusted only where nobody else can move it: not in a /tmp that is not sticky.
if folders.why_distrusted(Path(tempfile.gettempdir()), Path("/nowhere")):
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", "/var/tmp")

# What a shell starts in the background ignores Ctrl-C, and so would every client of our tests.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Snapshots and manifests of this run are not the user's, nor an earlier run's."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ENVHUB_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Iterator[None]:
    """In CI a skipped test is a failed one."""
    report = yield
    return _no_skips(report)  # type: ignore[return-value]


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Iterator[None]:
    """In CI a skipped module is a failed one."""
    report = yield
    return _no_skips(report)  # type: ignore[return-value]


def _no_skips(report: pytest.TestReport | pytest.CollectReport) -> object:
    skipped = report.outcome == "skipped" and not hasattr(report, "wasxfail")
    if not skipped or "ENVHUB_CI" not in os.environ:
        return report
    reason = str(report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr)
    permitted = any(text in reason and name in os.environ for text, name in _PERMITTED.items())
    if not permitted and not ("needs root" in reason and os.getuid() != 0):
        report.outcome = "failed"
        report.longrepr = f"{report.nodeid} must not be skipped in CI: {reason}"
    return report


@pytest.fixture(scope="session")
def checkout() -> Path:
    """The folder that holds README.md, docs/ and tests/."""
    return Path(__file__).resolve().parent.parent
