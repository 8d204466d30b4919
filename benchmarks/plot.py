"""A picture of a report: ratios to SyncVectorEnv, and how the cost of a step grows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.peers import PEERS
from benchmarks.workloads import WORKLOADS


def plot(results: dict[str, Any], path: Path) -> Path:
    """Write a PNG.

    Raises:
        ImportError: matplotlib is missing.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    conditions = list(dict.fromkeys(cell["condition"] for cell in results.get("steps", [])))
    growing = [_by_number, _by_bytes] if results.get("growth") else []
    rows = len(conditions) + (1 if growing else 0)
    figure = pyplot.figure(figsize=(16, 4.5 * max(rows, 1)), layout="constrained")
    grid = figure.add_gridspec(max(rows, 1), 2)
    for row, condition in enumerate(conditions):
        cells = [cell for cell in results["steps"] if cell["condition"] == condition]
        _bars(figure.add_subplot(grid[row, :]), condition, cells)
    for column, draw in enumerate(growing):
        draw(figure.add_subplot(grid[rows - 1, column]), results["growth"])
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
    return path


def _bars(axes: Any, condition: str, cells: list[dict[str, Any]]) -> None:
    """Medians of the ratios as bars, quartiles as whiskers, one group for each cell."""
    names = [name for name in PEERS if any(name in cell["peers"] for cell in cells)]
    width = 0.9 / max(len(names), 1)
    for offset, name in enumerate(names):
        found = [(i, cell["peers"].get(name, {}).get("x_sync")) for i, cell in enumerate(cells)]
        known = [(index, ratio) for index, ratio in found if ratio]
        medians = [ratio["median"] for _, ratio in known]
        spread = [
            [ratio["median"] - ratio["quartiles"][0] for _, ratio in known],
            [max(0.0, ratio["quartiles"][1] - ratio["median"]) for _, ratio in known],
        ]
        places = [index + offset * width - 0.45 for index, _ in known]
        low = [[max(0.0, value) for value in side] for side in spread]
        axes.bar(places, medians, width, yerr=low, label=PEERS[name].title, error_kw={"lw": 0.7})
    titles = [f"{WORKLOADS[cell['workload']].title}\nn = {cell['n']}" for cell in cells]
    axes.set_xticks(range(len(cells)), titles, fontsize=7)
    axes.set_yscale("log")
    axes.axhline(1.0, color="black", lw=0.8)
    axes.set_ylabel("times SyncVectorEnv's speed")
    axes.set_title(condition)
    axes.legend(fontsize=7, ncols=2)


def _by_number(axes: Any, cells: list[dict[str, Any]]) -> None:
    chosen = [cell for cell in cells if not WORKLOADS[cell["workload"]].grows]
    _lines(axes, chosen, [cell["n"] for cell in chosen])
    axes.set_xlabel("CartPoles in one vector step")


def _by_bytes(axes: Any, cells: list[dict[str, Any]]) -> None:
    chosen = [cell for cell in cells if WORKLOADS[cell["workload"]].grows]
    _lines(axes, chosen, [WORKLOADS[cell["workload"]].arguments["size"] for cell in chosen])
    axes.set_xlabel("bytes of one observation, 4 sub-environments")


def _lines(axes: Any, cells: list[dict[str, Any]], where: list[int]) -> None:
    for name in PEERS:
        points = [
            (place, cell["peers"][name]["p50_us"])
            for place, cell in zip(where, cells, strict=True)
            if name in cell["peers"]
        ]
        if points:
            axes.plot(*zip(*points, strict=True), marker="o", label=PEERS[name].title)
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    axes.set_ylabel("microseconds for one vector step (p50)")
    if cells:
        axes.legend(fontsize=7)
