"""The tables of ``docs/checks.md``, written from the checks and the settings.
Write it again with ``python -m tests.support.documents.checks``."""

import textwrap

from envhub_sandbox.extras.judge.checks import CHECKS
from envhub_sandbox.extras.judge.command.check import SETTINGS
from tests.support.documents.written import DOCS, filled

DOCUMENT = DOCS / "checks.md"
_CHECKS = (
    "| Check | Severity | What is true if it passes | How to fix it |\n| --- | --- | --- | --- |"
)


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
    )


if __name__ == "__main__":
    DOCUMENT.write_text(document())
