"""Findings as lines, ``--fail-on``, and GitHub's annotations."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from envhub_sandbox.cli.shared.console import command, show
from envhub_sandbox.cli.shared.exits import UsageError

if TYPE_CHECKING:
    from envhub_sandbox.extras.judge.checks import Severity
    from envhub_sandbox.extras.judge.findings import Finding

_MOST_OF_A_SUMMARY = 1_000_000
"""Characters, all of them ASCII: GitHub takes 1 MiB for each step."""
STYLES = {"error": "red", "warning": "yellow", "note": "dim"}


def show_finding(finding: Finding, *, fails: bool = False) -> None:
    """Print what was found, and what cures it where it fails the whole."""
    severity = finding.check.severity.value
    task = f"{finding.task}: " if finding.task else ""
    show(severity, f"{finding.id}: {task}{finding.text}", STYLES[severity])
    if fails:
        show("", finding.cure, "dim")


def level(name: str) -> Severity:
    """What ``--fail-on`` says. Raises ``UsageError``: it says something else."""
    from envhub_sandbox.extras.judge.checks import Severity

    if name not in {severity.value for severity in Severity}:
        raise UsageError(f"--fail-on is {name!r}; it takes error, warning or note")
    return Severity(name)


def write_report(path: Path, text: str, references: Iterable[str]) -> None:
    """Write a report about these, in UTF-8 whatever the locale.
    Raises ``UsageError``: it cannot be written; ``PolicyError``: one of them has put a link there.
    """
    from envhub_sandbox.extras.judge.settings import refuse_link_of_the_judged

    for reference in references:
        refuse_link_of_the_judged(path, reference)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"the report cannot be written: {error}") from error


def annotate(commands: Iterable[str], summary: str) -> None:
    """Print GitHub's workflow commands, and append to its step's summary, of which it shows nothing
    where it is too long: then the last lines are left out.
    """
    for line in commands:
        command(line)
    if path := os.environ.get("GITHUB_STEP_SUMMARY"):
        end = len(summary)
        if end > _MOST_OF_A_SUMMARY:
            end = summary.rfind("\n", 0, _MOST_OF_A_SUMMARY) + 1
        left_out = summary.count("\n", end)
        with Path(path).open("a", encoding="utf-8") as file:
            file.write(summary[:end] + f"\n{left_out} more are left out.\n" * bool(left_out))
