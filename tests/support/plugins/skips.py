"""A pytest plugin: names each failure as it happens, and at the end what could not be tested, in
one line for each reason; in CI that is failed.
"""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator

import pytest

# Reasons for which a test may be skipped in CI, each with the variable that permits it there.
_PERMITTED = {
    "needs torch": "ENVHUB_CI_WITHOUT_TORCH",
    "no GPU": "ENVHUB_CI_WITHOUT_GPU",
    "may not make control groups": "ENVHUB_CI_WITHOUT_CGROUPS",
    "there is no prometheus": "ENVHUB_CI_WITHOUT_PROMETHEUS",
}
_NOT_INSTALLED = re.compile(r"could not import '([\w.]+)'")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Iterator[None]:
    """In CI a skipped test is a failed one."""
    report = yield
    return _no_skips(report)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Iterator[None]:
    """In CI a skipped module is a failed one."""
    report = yield
    return _no_skips(report)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Name a failure at once: a run that is killed prints no summary."""
    if report.failed and "PYTEST_XDIST_WORKER" not in os.environ:
        print(f"\nfailed now: {report.nodeid}", flush=True)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Under the results: how many tests each reason has cost."""
    reasons = by_reason(terminalreporter.stats.get("skipped", ()))
    if not reasons:
        return
    terminalreporter.section("what could not be tested here", sep="-")
    for reason, tests in sorted(reasons.items(), key=lambda item: (-len(item[1]), item[0])):
        number = f"{len(tests)} test{'s' if len(tests) > 1 else ''}"
        terminalreporter.write_line(f"{number} skipped: {reason}")


def by_reason(reports: Iterable[pytest.TestReport | pytest.CollectReport]) -> dict[str, set[str]]:
    """The skipped tests (or modules) of each reason; processes that say the same count once."""
    found: dict[str, set[str]] = defaultdict(set)
    for report in reports:
        found[reason_of(report)].add(report.nodeid)
    return dict(found)


def reason_of(report: pytest.TestReport | pytest.CollectReport) -> str:
    told = report.longrepr
    text = str(told[2] if isinstance(told, tuple) else told).removeprefix("Skipped: ")
    missing = _NOT_INSTALLED.search(text)
    return f"needs {missing[1]}" if missing else " ".join(text.split())


def _no_skips(report: pytest.TestReport | pytest.CollectReport) -> object:
    skipped = report.outcome == "skipped" and not hasattr(report, "wasxfail")
    if not skipped or "ENVHUB_CI" not in os.environ:
        return report
    reason = reason_of(report)
    permitted = any(text in reason and name in os.environ for text, name in _PERMITTED.items())
    if not permitted and not ("needs root" in reason and os.getuid() != 0):
        report.outcome = "failed"
        report.longrepr = f"{report.nodeid} must not be skipped in CI: {reason}"
    return report
