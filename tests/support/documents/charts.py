"""The plots of ``docs/benchmarks.md``, drawn from tables of ``docs/internals/benchmarks.md``.

Each is a picture of ``docs/assets`` that loads nothing, on the ground of the pictures of terminals,
so that it can be read on light and dark pages and on a telephone. Draw them again with
``python -m tests.support.documents.charts``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from tests.support.documents.written import DOCS, filled

DOCUMENT = DOCS / "benchmarks.md"
MEASURED = DOCS / "internals" / "benchmarks.md"
ASSETS = DOCS / "assets"
OURS = "envhub"
_STEPS = (
    ("1 CartPole", "CartPole, quiet", "1"),
    ("16 CartPoles", "CartPole, quiet", "16"),
    ("64 CartPoles", "CartPole, quiet", "64"),
    ("16 HalfCheetahs (MuJoCo)", "HalfCheetah, quiet", "16"),
    ("8 environments with two cameras", "2 cameras, quiet", "8"),
)
_BESIDE = re.compile(
    r"CartPole, n = 16, in the same runs: [\d.]+ and ([\d.]+) times PufferLib's speed "
    r"\(target [\d.]+\), [\d.]+ and ([\d.]+) times OpenEnv's"
)
"""Of the second machine, as in the column B."""
_EVALUATIONS = ("LeRobot, sync", "LeRobot, async", "envhub, sync", "envhub, async")
_WIDTH, _LEFT, _RIGHT, _TOP = 480, 142, 56, 16
_BAR, _ROW, _HEAD = 15, 22, 30
_FONT = 'text{font-size:14px;font-family:system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}'
_GROUND, _TEXT, _DIM, _OWN, _OTHER = "#171a23", "#d6dae4", "#aab1c3", "#26a69a", "#5b647c"


@dataclass(frozen=True)
class Plot:
    """Horizontal bars in groups.

    Attributes:
        title: What their lengths are.
        groups: The bars of each, by name.
        form: Of a number, as ``format`` takes it.
    """

    title: str
    groups: Mapping[str, Mapping[str, float]]
    form: str


def document() -> str:
    shown = {name: f"![{_told(plot)}](assets/{name}.svg)" for name, plot in plots().items()}
    return filled(DOCUMENT, **shown)


def pictures() -> dict[Path, str]:
    return {ASSETS / f"{name}.svg": drawn(plot) for name, plot in plots().items()}


def plots() -> dict[str, Plot]:
    """The three of the page, by the names of their places in it."""
    return {"steps": _steps(), "evaluation": _evaluation(), "memory": _memory()}


def _steps() -> Plot:
    rows = {
        (row["workload, condition"], row["n"]): row["B"] for row in _table("workload, condition")
    }
    groups = {title: _speeds(rows[workload, n]) for title, workload, n in _STEPS}
    beside = _BESIDE.search(" ".join(MEASURED.read_text().split()))
    assert beside is not None
    ours = groups["16 CartPoles"].pop(OURS)
    groups["16 CartPoles"] |= {
        "OpenEnv": ours / float(beside[2]),
        "PufferLib": ours / float(beside[1]),
        OURS: ours,
    }
    return Plot("Speed of steps, times that of SyncVectorEnv", groups, ".2f")


def _speeds(cell: str) -> dict[str, float]:
    """Of ``ours / SyncVectorEnv's`` and ``ours / AsyncVectorEnv's``, in times SyncVectorEnv's."""
    by_sync, by_async = map(_first, cell.split(" / "))
    return {"AsyncVectorEnv": by_sync / by_async, "SyncVectorEnv": 1.0, OURS: by_sync}


def _evaluation() -> Plot:
    rows = {row[""]: row for row in _table("6 simulators")}
    suites = {
        "6 simulators, each built in one second": "6 simulators",
        "10 light tasks": "10 light",
    }
    groups = {
        title: {name: _first(rows[name][_column(rows[name], column)]) for name in _EVALUATIONS}
        for title, column in suites.items()
    }
    return Plot("Seconds for a suite: less is better", groups, ".2f")


def _column(row: Mapping[str, str], begins: str) -> str:
    return next(name for name in row if name.startswith(begins))


def _memory() -> Plot:
    groups = {
        f"{row['sub-environments, memory in MB']} CartPoles": {
            name: _first(row[name]) for name in ("AsyncVectorEnv", "SyncVectorEnv", OURS)
        }
        for row in _table("sub-environments, memory in MB")
    }
    return Plot("MB of memory: less is better", groups, ".0f")


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


def _told(plot: Plot) -> str:
    """All of its numbers as a sentence, for people who do not see it."""
    groups = (
        f"{title}: {', '.join(f'{name} {size:{plot.form}}' for name, size in bars.items())}"
        for title, bars in plot.groups.items()
    )
    return f"{plot.title}. {'; '.join(groups)}."


def drawn(plot: Plot) -> str:
    """The picture: the longest bar takes the whole width."""
    scale = (_WIDTH - _LEFT - _RIGHT) / max(
        size for bars in plot.groups.values() for size in bars.values()
    )
    lines, y = [_label(_TOP, _TOP + 14, plot.title, _DIM)], _TOP + 18
    for title, bars in plot.groups.items():
        y += _HEAD
        lines.append(_label(_TOP, y - 8, title, _TEXT, weight="bold"))
        for name, size in bars.items():
            own = name.startswith(OURS)
            length = max(size * scale, 1.5)
            lines += [
                _label(_LEFT - 8, y + 12, name, _TEXT if own else _DIM, anchor="end"),
                f'<rect x="{_LEFT}" y="{y}" width="{length:.1f}" height="{_BAR}" rx="2" '
                f'fill="{_OWN if own else _OTHER}"/>',
                _label(_LEFT + length + 6, y + 12, f"{size:{plot.form}}", _TEXT if own else _DIM),
            ]
            y += _ROW
    height = y + _TOP
    return "\n".join(
        [
            '<svg xmlns="http://www.w3.org/2000/svg" role="img" '
            f'viewBox="0 0 {_WIDTH} {height}" width="{_WIDTH}" height="{height}">',
            f"<title>{escape(plot.title)}</title>",
            f"<style>{_FONT}</style>",
            f'<rect width="100%" height="100%" rx="10" fill="{_GROUND}"/>',
            *lines,
            "</svg>\n",
        ]
    )


def _label(
    x: float, y: float, text: str, fill: str, *, anchor: str = "start", weight: str = "normal"
) -> str:
    return (
        f'<text x="{x:.1f}" y="{y}" text-anchor="{anchor}" font-weight="{weight}" fill="{fill}">'
        f"{escape(text)}</text>"
    )


def main() -> None:
    """Draw them, and name them on the page."""
    for path, text in pictures().items():
        path.write_text(text)
    DOCUMENT.write_text(document())


if __name__ == "__main__":
    main()
