"""The plots of ``docs/benchmarks.md``, drawn from tables of ``docs/internals/benchmarks.md``.

Draw them again with ``python -m tests.support.documents.charts``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence

from tests.support.documents.written import DOCS, filled

DOCUMENT = DOCS / "benchmarks.md"
MEASURED = DOCS / "internals" / "benchmarks.md"
_STEPS = {
    "CartPole": "CartPole, quiet",
    "Cheetah": "HalfCheetah, quiet",
    "cam": "2 cameras, quiet",
}
_SIZES = (("CartPole", 1), ("CartPole", 16), ("CartPole", 64), ("Cheetah", 16), ("Cheetah", 64))
_EVALUATIONS = {
    "LeRobot sync": "LeRobot, sync",
    "LeRobot async": "LeRobot, async",
    "envhub sync": "envhub, sync",
    "envhub async": "envhub, async",
}
_MEMORY = (("sync", "SyncVectorEnv"), ("async", "AsyncVectorEnv"), ("envhub", "envhub"))
_BAR, _GREY = "#26a69a", "#808890"
_GREYS = (
    "xAxisLabel",
    "xAxisLine",
    "xAxisTick",
    "yAxisLabel",
    "yAxisTitle",
    "yAxisLine",
    "yAxisTick",
)


def document() -> str:
    """What the page has to hold."""
    return filled(DOCUMENT, steps=_steps(), evaluation=_evaluation(), memory=_memory())


def _steps() -> str:
    rows = {
        (row["workload, condition"], row["n"]): row["B"] for row in _table("workload, condition")
    }
    shown = (*_SIZES, ("cam", 8))
    bars = {f"{name} {n}": _first(rows[_STEPS[name], str(n)]) for name, n in shown}
    return _chart(bars, "times SyncVectorEnv", 2.5)


def _evaluation() -> str:
    rows = {row[""]: row["6 simulators"] for row in _table("6 simulators")}
    bars = {name: _first(rows[label]) for name, label in _EVALUATIONS.items()}
    return _chart(bars, "seconds, less is better", 14)


def _memory() -> str:
    rows = _table("sub-environments, memory in MB")
    bars = {
        f"{name} {row['sub-environments, memory in MB']}": _first(row[column])
        for row in rows
        for name, column in _MEMORY
    }
    return _chart(bars, "MB, less is better", 300)


def _table(column: str) -> Sequence[Mapping[str, str]]:
    """The rows of the one table that has such a column."""
    tables = re.findall(r"(?:^\|.*\|\n)+", MEASURED.read_text(), re.M)
    cells = [[_cells(line) for line in table.splitlines()] for table in tables]
    [[head, _, *rows]] = [lines for lines in cells if column in lines[0]]
    return [dict(zip(head, row, strict=True)) for row in rows]


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def _first(cell: str) -> float:
    """The number that a cell begins with, also in bold."""
    found = re.match(r"\**(\d+\.?\d*)", cell)
    assert found is not None, cell
    return float(found[1])


def _chart(bars: Mapping[str, float], title: str, top: float) -> str:
    greys = {f"{name}Color": _GREY for name in _GREYS}
    colours = {"plotColorPalette": _BAR, "backgroundColor": "transparent", **greys}
    size = {"xyChart": {"width": 640, "height": 250}, "themeVariables": {"xyChart": colours}}
    return "\n".join(
        [
            "```mermaid",
            f"%%{{init: {json.dumps(size)}}}%%",
            "xychart-beta",
            f"  x-axis {json.dumps(list(bars))}",
            f'  y-axis "{title}" 0 --> {top:g}',
            f"  bar {json.dumps(list(bars.values()))}",
            "```",
        ]
    )


if __name__ == "__main__":
    DOCUMENT.write_text(document())
