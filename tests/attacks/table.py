"""The table of attacks as a page: columns for a user and root under each profile.

A run knows one user's columns; those of the other one are taken over from the page as it is.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path

import pytest

from tests.attacks.harness import Row

JUDGED = "judged"
COLUMNS = (
    JUDGED,
    "control, user",
    "control, root",
    "strict, user",
    "strict, root",
    "no-userns, user",
    "no-userns, root",
)
HEAD = """# Attacks

Written by the attack suite (`ENVHUB_ATTACK_TABLE=docs/attacks.md pytest tests/attacks`, once as a
plain user and once as root); do not edit by hand. Each attack runs twice in the same test: without
a sandbox (the *control*), where it must succeed, and inside. `docs/threat-model.md` explains what
is not stopped.

- **judged**: who says whether it succeeded. *Outside*: a listener, a file, a victim process, the
  process table, the kernel's accounts, or a random token in what the repository returned. *By its
  answer*: the call leaves no trace, so that the payload's word has to do; outside, where it has no
  reason to lie, the same call must be answered differently.
- **succeeds**: the control did what the attack wants.
- **stopped**: the same payload did not do it inside.
- **NOT STOPPED**: it did. The suite asserts that it does, except for the bombs that are only
  measured now and then under `no-userns` without a control group: those depend on the load.
- **no proof**: the control is not possible for this user or on this host (the reason stands
  below the table), so that nothing follows from its failing inside.
"""
_START = "| attack |"

Page = dict[str, dict[str, dict[str, str]]]


class Collected:
    """The rows of one table, from the tests that find them to the page.

    With xdist they come from its workers, in the reports of the tests.

    Args:
        name: Tells these rows from those of other tables in a report.
        variable: Of the environment; it names the page, if one is to be written.
        columns: Of the page.
        head: What stands above the tables.
    """

    def __init__(
        self, name: str, variable: str, columns: Sequence[str] = COLUMNS, head: str = HEAD
    ) -> None:
        self._name, self._variable = name, variable
        self._columns, self._head = columns, head
        self._rows: list[Row] = []

    def found(self, test: pytest.Item, rows: Iterable[Row]) -> None:
        """Have a test's report carry what it has found."""
        test.user_properties += [(self._name, asdict(row)) for row in rows]

    def read(self, report: pytest.TestReport) -> None:
        """Take the rows out of a report."""
        if report.when == "teardown":
            found = [row for name, row in report.user_properties if name == self._name]
            self._rows += [Row(**row) for row in found]  # type: ignore[arg-type]

    def write(self, session: pytest.Session) -> None:
        """Write the page, if asked to."""
        path = os.environ.get(self._variable)
        if path and self._rows and not hasattr(session.config, "workerinput"):
            update(Path(path), self._rows, columns=self._columns, head=self._head)


def update(
    path: Path, rows: Iterable[Row], *, columns: Sequence[str] = COLUMNS, head: str = HEAD
) -> None:
    """Write ``rows`` into the page at ``path``, over what they know better."""
    page = _parse(path.read_text()) if path.exists() else {}
    notes = _notes(path.read_text()) if path.exists() else {}
    for row in rows:
        cells = page.setdefault(row.family, {}).setdefault(row.attack, {})
        cells[JUDGED] = row.judged
        cells[f"control, {row.user}"] = row.control
        cells[f"{row.profile}, {row.user}"] = row.inside
        if row.control == "not possible":
            notes[f"{row.attack}, {row.user}"] = row.detail
        else:
            notes.pop(f"{row.attack}, {row.user}", None)
    path.write_text(_page(page, notes, columns, head))


def attacks_on(page: str) -> set[str]:
    """The titles of all attacks on a page."""
    return {attack for family in _parse(page).values() for attack in family}


def _page(page: Page, notes: dict[str, str], columns: Sequence[str], head: str) -> str:
    parts = [head]
    for family in sorted(page):
        parts.append(f"\n## {family}\n\n{_START} {' | '.join(columns)} |")
        parts.append("|---" * (len(columns) + 1) + "|")
        for attack in sorted(page[family]):
            cells = [page[family][attack].get(column, "") for column in columns]
            parts.append(f"| {attack} | {' | '.join(cells)} |")
    if notes:
        parts.append("\n## Controls that are not possible\n")
        parts += [f"- {name}: {notes[name]}" for name in sorted(notes)]
    return "\n".join(parts) + "\n"


def _parse(text: str) -> Page:
    page: Page = {}
    family = ""
    columns: list[str] = []
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip().removesuffix("|").split("|")[1:]]
        if line.startswith("## "):
            family = line[3:]
        elif line.startswith(_START):
            columns = cells[1:]
        elif line.startswith("| "):
            attack, *cells = cells
            page.setdefault(family, {})[attack] = dict(zip(columns, cells, strict=True))
    return page


def _notes(text: str) -> dict[str, str]:
    _, _, below = text.partition("\n## Controls that are not possible\n")
    lines = [line[2:] for line in below.splitlines() if line.startswith("- ")]
    return dict(line.split(": ", 1) for line in lines)
