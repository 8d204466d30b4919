"""What was read of a repository, line by line: its words are a stranger's on each of them.

A line begins with a word of ours, and none is wrapped: what a terminal or GitHub's runner obeys
stands at a line's beginning, or is ``##[``, which is broken up.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from envhub_sandbox.cli.shared.console import console, safe_line
from envhub_sandbox.cli.shared.exits import UsageError

if TYPE_CHECKING:
    from envhub_sandbox.check.findings import Finding
    from envhub_sandbox.check.table import Severity

STYLES = {"error": "red", "warning": "yellow", "note": "dim"}
_WIDTH = 11

FailOn = Annotated[
    str | None,
    typer.Option(
        "--fail-on",
        metavar="error|warning|note",
        help="Exit with 1 if something is found that weighs as much.",
    ),
]


def show(word: str, text: str = "", style: str | None = None) -> None:
    """Print a line: a word of ours, and what may be a stranger's."""
    line = safe_line(text, 500).replace("##[", "#\\x23[")
    console().print(f"{word:{_WIDTH}} {line}".rstrip(), style=style, soft_wrap=True)


def show_finding(one: Finding, mark: str = "") -> None:
    """Print what was found."""
    severity = one.check.severity.value
    show(f"{mark}{severity}", f"{one.id}: {one.text}", STYLES[severity])


def level(name: str) -> Severity:
    """What ``--fail-on`` says.

    Raises:
        UsageError: It says something else.
    """
    from envhub_sandbox.check.table import Severity

    if name not in {one.value for one in Severity}:
        raise UsageError(f"--fail-on is {name!r}; it takes error, warning or note")
    return Severity(name)


def annotate(commands: Iterable[str], summary: str) -> None:
    """Print GitHub's workflow commands, and append to its step's summary."""
    for line in commands:
        typer.echo(line)
    if path := os.environ.get("GITHUB_STEP_SUMMARY"):
        with Path(path).open("a", encoding="utf-8") as file:
            file.write(summary)
