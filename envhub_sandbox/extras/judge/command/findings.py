"""Prints findings as lines and as GitHub's annotations, and reads ``--fail-on``."""

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
"""Characters, all ASCII: GitHub takes 1 MiB per step."""
STYLES = {"error": "red", "warning": "yellow", "note": "dim"}


def show_finding(finding: Finding, *, fails: bool = False) -> None:
    """Print a finding, and its cure if it fails the judgement."""
    severity = finding.check.severity.value
    task = f"{finding.task}: " if finding.task else ""
    show(severity, f"{finding.id}: {task}{finding.text}", STYLES[severity])
    if fails:
        show("", finding.cure, "dim")


def level(name: str) -> Severity:
    """Returns the severity for ``--fail-on``. Raises ``UsageError``: the name is unknown."""
    from envhub_sandbox.extras.judge.checks import Severity

    if name not in {severity.value for severity in Severity}:
        raise UsageError(f"--fail-on is {name!r}; it takes error, warning or note")
    return Severity(name)


def write_report(path: Path, text: str, references: Iterable[str]) -> None:
    """Write a report about these references, always in UTF-8.
    Raises ``UsageError``: it is unwritable; ``PolicyError``: a repository has put a link there.
    """
    from envhub_sandbox.extras.judge.settings import refuse_link_of_the_judged

    for reference in references:
        refuse_link_of_the_judged(path, reference)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"the report cannot be written: {error}") from error


def annotate(commands: Iterable[str], summary: str) -> None:
    """Print GitHub's workflow commands, and append to the step's summary. GitHub shows nothing of a
    summary that is too long, so this function leaves out the last lines.
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
