"""``docs/internals/faults-tried.md``, from the table: ``python -m tests.faults.matrix.document``.
The seconds are the median cell of a row in one full run, kept in ``measured.json``."""

import json
from pathlib import Path

from tests.faults.matrix.table import FAULTS, MOMENTS, ROWS, Row
from tests.support.documents.written import DOCS, filled

DOCUMENT = DOCS / "internals" / "faults-tried.md"
_MEASURED = Path(__file__).with_name("measured.json")


def document() -> str:
    """What the file has to hold."""
    measured = json.loads(_MEASURED.read_text())
    heads = ("The repository's code", "when", "you see", "in seconds", "then the environment")
    rows = [heads, ("---",) * len(heads), *(_cells(row, measured) for row in ROWS)]
    return filled(DOCUMENT, rows="\n".join(f"| {' | '.join(row)} |" for row in rows))


def _cells(row: Row, measured: dict[str, float]) -> tuple[str, ...]:
    seconds = measured[row.name]
    shown = "under 0.1" if seconds < 0.1 else f"{seconds:.1f}"
    return FAULTS[row.fault], MOMENTS[row.moment], _seen(row), shown, row.then


def _seen(row: Row) -> str:
    if row.error is None:
        return "nothing"
    found = {name: value for name, value in row.attributes.items() if value is not None}
    details = ", ".join(f"{name}={value!r}" for name, value in found.items())
    return f"`{row.error}`" + (f": `{details}`" if details else "")


if __name__ == "__main__":
    DOCUMENT.write_text(document())
