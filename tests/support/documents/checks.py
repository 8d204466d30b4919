"""The tables of ``docs/checks.md``, written from the checks, the settings and the corpus.

Write it again with ``python -m tests.support.documents.checks``.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator

from envhub_sandbox.check.checks import CHECKS
from envhub_sandbox.cli.check.check import SETTINGS
from tests.corpus.entries import Entry
from tests.corpus.faults import FAULTS
from tests.corpus.honest import HONEST
from tests.support.documents.written import DOCS, filled

DOCUMENT = DOCS / "checks.md"
_CHECKS = (
    "| Check | Severity | What is true if it passes | How to fix it |\n| --- | --- | --- | --- |"
)
_CORPUS = "| Repositories | Number | Right | Missed | False |\n| --- | --- | --- | --- | --- |"


def document() -> str:
    rows = [
        f"| `{check.id}` | {check.severity.value} | {check.sentence} | {check.cure} |"
        for check in CHECKS.values()
    ]
    options = ", ".join(f"`{name.replace('_', '-')}`" for name in SETTINGS)
    return filled(
        DOCUMENT,
        settings=textwrap.fill(f"{options}.", 100, break_on_hyphens=False),
        checks="\n".join([_CHECKS, *rows]),
        corpus="\n".join([_CORPUS, *_judged()]),
    )


def _judged() -> Iterator[str]:
    """A row for each group of the corpus, and one for all; ``tests.corpus`` judges every entry."""
    groups: dict[str, list[Entry]] = {}
    for entry in (*HONEST.values(), *FAULTS.values()):
        groups.setdefault(entry.group, []).append(entry)
    for name, entries in {**groups, "all": [*HONEST.values(), *FAULTS.values()]}.items():
        missed = sum(bool(entry.right - entry.expected) for entry in entries)
        false = sum(bool(entry.expected - entry.right) for entry in entries)
        right = sum(entry.expected == entry.right for entry in entries)
        yield f"| {name} | {len(entries)} | {right} | {missed} | {false} |"
    for name, entry in {**HONEST, **FAULTS}.items():
        if entry.expected != entry.right:
            yield f"\nNot found: “{name}”: {entry.why}"


if __name__ == "__main__":
    DOCUMENT.write_text(document())
