"""The table of attacks as a page: columns for a user and root under each profile.
A run knows one user's columns; those of the other one are taken over from the page as it is.
``python -m tests.attacks.table attacks.md`` writes the summary of such a page, ``docs/attacks.md``.
"""

import os
import sys
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

`ENVHUB_ATTACK_TABLE=attacks.md pytest tests/attacks`, run once as a plain user and once as root,
writes a table of every attack. Each attack runs without a sandbox (the *control*, once for all
profiles), where it must succeed, and inside. `docs/threat-model.md` explains what is not stopped.

- **judged**: what decides whether it succeeded. *Outside*: a listener, a file, a victim process,
  the process table, the kernel's accounts, or a random token in what the repository returned. *By
  its answer*: the call leaves no trace, so the attack's own report of the kernel's answer is
  used; it must differ from the answer outside.
- **succeeds**: the control did what the attack intends.
- **stopped**: the same attack failed inside.
- **NOT STOPPED**: the attack succeeded inside. The suite asserts this, except for bombs that are
  only sampled (`no-userns` without a control group), because these depend on the load.
- **no proof**: the control is impossible for this user or on this host (the reason is below the
  table), so its failure inside proves nothing.
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
        if report.when == "teardown":
            found = [row for name, row in report.user_properties if name == self._name]
            self._rows += [Row(**row) for row in found]

    def write(self, session: pytest.Session) -> None:
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


def summary(text: str, head: str = HEAD) -> str:
    """Of a page: how many attacks of each family there are, and those that are not stopped."""
    lines = [head, "## How many", "", "| | attacks | not stopped | no proof for one user |"]
    lines.append("|---|---|---|---|")
    open_rows: list[str] = []
    for family, attacks in sorted(_parse(text).items()):
        cells = {attack: [*found.values()] for attack, found in attacks.items()}
        succeeding = [attack for attack in sorted(cells) if "NOT STOPPED" in cells[attack]]
        unproved = sum("no proof" in found for found in cells.values())
        lines.append(f"| {family} | {len(cells)} | {len(succeeding)} | {unproved} |")
        open_rows += [f"| {one} | {' | '.join(cells[one])} |" for one in succeeding]
    lines += ["", "## Not stopped", "", f"{_START} {' | '.join(COLUMNS)} |"]
    return "\n".join([*lines, "|---" * (len(COLUMNS) + 1) + "|", *open_rows, ""])


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


if __name__ == "__main__":
    _docs = Path(__file__).parents[2] / "docs"
    (_docs / "attacks.md").write_text(summary(Path(sys.argv[1]).read_text()))
