"""How a step's time grows with the number of sub-environments, their bytes, and the processes.

A batched environment of a repository's own is stepped in this process and in the sandbox, with
``copy=True`` and ``False``, beside what two copies of its observation take: the sandbox cannot be
faster with ``copy=True``, nor than one with ``False``. 64 CartPoles are stepped by 1 to 64
processes, beside ``AsyncVectorEnv``. Each row's ways take turns. A figure is the 10th percentile of
a turn in microseconds, of the turn where it is least: other programs can only add to it. ``--plot``
draws them.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np

from benchmarks.clock import Slice, run_slice
from benchmarks.load import load_average, stolen
from benchmarks.machine import machine
from benchmarks.workloads import REPOSITORIES, WORKLOADS, makers, module
from envhub_sandbox import make_env

_ROW_BYTES = 256
_CARTPOLES = 64
_LEAST_STEPS = 20
_BATCH = REPOSITORIES / "batch"
Row = dict[str, float]
Series = dict[float, Row]


class Copies:
    """What two copies of a batch take: into a slab, and out of it into a new array."""

    def __init__(self, batch: Any) -> None:
        self._batch, self._slab = batch, np.empty_like(batch)

    def step(self, actions: Any) -> Any:
        """As an environment's."""
        self._slab[...] = self._batch
        return self._slab.copy()


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line as soon as it is measured."""
    options = _parser().parse_args(arguments)
    if options.nice:
        os.nice(options.nice)
    facts = machine()
    print(f"{facts['processor']}, {facts['cores']} cores", flush=True)
    found: dict[str, Series] = {}
    growing: list[tuple[str, list[int], Callable[[int], tuple[Row, float]]]] = [
        (
            f"sub-environments of {_ROW_BYTES} B",
            options.sizes,
            lambda count: _batched(count, _ROW_BYTES, options),
        ),
        ("bytes of one observation", options.bytes, lambda size: _batched(1, size, options)),
        (
            f"processes for {_CARTPOLES} CartPoles",
            options.processes,
            lambda count: _in_processes(count, options),
        ),
    ]
    with tempfile.TemporaryDirectory() as cache, patch.dict(os.environ, {"ENVHUB_CACHE": cache}):
        for title, keys, measured in growing:
            found[title] = _printed(title, keys, map(measured, keys))
    if options.plot:
        options.plot.write_text(picture(found) + "\n")


def _printed(title: str, keys: Iterable[int], rows: Iterable[tuple[Row, float]]) -> Series:
    series: Series = {}
    for key, (row, share) in zip(keys, rows, strict=True):
        if not series:
            print(f"\n| {title} | " + " | ".join(row) + " | stolen | load |")
            print("|---" * (len(row) + 3) + "|")
        cells = [f"{key:,}", *(f"{value:.1f}" for value in row.values()), f"{share:.1%}"]
        print("| " + " | ".join(cells) + f" | {load_average():.1f} |", flush=True)
        series[key] = row
    return series


def _batched(count: int, size: int, options: argparse.Namespace) -> tuple[Row, float]:
    kwargs = {"size": size}
    with ExitStack() as stack:
        here = module(_BATCH).make_env(count, **kwargs)
        ways = {"no sandbox": here, "two copies": Copies(here.values[0])}
        for name, copy in (("envhub", True), ("envhub, copy=False", False)):
            made = make_env(str(_BATCH), count, env_kwargs=kwargs, copy=copy)
            ways[name] = stack.enter_context(made).env
            ways[name].reset(seed=0)
        return _turns(ways, [np.zeros(count, np.int64)], options)


def _in_processes(count: int, options: argparse.Namespace) -> tuple[Row, float]:
    with ExitStack() as stack:
        ways: dict[str, Any] = {}
        for kind in (gym.vector.SyncVectorEnv, gym.vector.AsyncVectorEnv):
            ways[kind.__name__] = kind(makers("cartpole", _CARTPOLES))
            stack.callback(ways[kind.__name__].close)
        folder = str(WORKLOADS["cartpole"].folder)
        made = make_env(folder, _CARTPOLES, use_async_envs=True, num_workers=count)
        ways["envhub"] = stack.enter_context(made).env
        for env in ways.values():
            env.reset(seed=0)
        return _turns(ways, [np.ones(_CARTPOLES, np.int64)], options)


def _turns(
    ways: dict[str, Any], batches: list[Any], options: argparse.Namespace
) -> tuple[Row, float]:
    """The least 10th percentile of each way's turns, and the share that was stolen."""
    times: dict[str, list[float]] = {name: [] for name in ways}
    before, actions = stolen(), itertools.cycle(batches)
    for turn in range(options.rounds):
        names = [*ways]
        for name in names[turn % len(names) :] + names[: turn % len(names)]:
            summary = run_slice(ways[name], Slice(options.seconds, _LEAST_STEPS), actions)
            times[name].append(summary["p10_ns"] / 1e3)
    lost, passed = (late - early for late, early in zip(stolen(), before, strict=True))
    return {name: min(one) for name, one in times.items()}, lost / max(passed, 1)


# --- the picture --------------------------------------------------------------------------------

_WIDTH, _LEFT, _HEIGHT, _GAP = 480, 64, 190, 66
_COLOURS = {
    "envhub": "#26a69a",
    "envhub, copy=False": "#80cbc4",
    "two copies": "#e0a458",
    "no sandbox": "#8a93a8",
    "SyncVectorEnv": "#8a93a8",
    "AsyncVectorEnv": "#5b8def",
}


def picture(found: dict[str, Series]) -> str:
    """Microseconds of a step, both axes logarithmic: an SVG with a chart for each series."""
    height = len(found) * (_HEIGHT + _GAP) + 12
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" role="img" viewBox="0 0 {_WIDTH} {height}" '
        f'width="{_WIDTH}" height="{height}">',
        "<title>Microseconds of a step</title>",
        "<style>text{font:13px system-ui,sans-serif;fill:#aab1c3}</style>",
        '<rect width="100%" height="100%" rx="10" fill="#171a23"/>',
    ]
    for index, (title, series) in enumerate(found.items()):
        parts += _chart(title, series, 28 + index * (_HEIGHT + _GAP))
    return "\n".join([*parts, "</svg>"])


def _chart(title: str, series: Series, top: int) -> Iterator[str]:
    yield f'<text x="16" y="{top}" style="fill:#d6dae4">us of a step, by {title}</text>'
    x = _axis(series, _LEFT, _WIDTH - 16)
    values = [value for row in series.values() for value in row.values()]
    y = _axis(values, top + _HEIGHT, top + 36)
    for decade in _decades(values):
        yield f'<path d="M{_LEFT} {y(decade):.1f}H{_WIDTH - 16}" stroke="#2c3244"/>'
        yield f'<text x="{_LEFT - 6}" y="{y(decade) + 4:.1f}" text-anchor="end">{decade:g}</text>'
    for key in series:
        below = f'y="{top + _HEIGHT + 18}" text-anchor="middle"'
        yield f'<text x="{x(key):.1f}" {below}>{_short(key)}</text>'
    left = 16
    for name in next(iter(series.values())):
        points = " ".join(f"{x(key):.1f},{y(row[name]):.1f}" for key, row in series.items())
        colour = _COLOURS[name]
        yield f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="2"/>'
        yield f'<text x="{left}" y="{top + 18}" style="fill:{colour}">{name}</text>'
        left += 9 * len(name) + 6


def _decades(values: Iterable[float]) -> list[float]:
    logs = [math.log10(value) for value in values]
    return [10.0**power for power in range(math.ceil(min(logs)), math.floor(max(logs)) + 1)]


def _axis(values: Iterable[float], start: float, end: float) -> Any:
    low, high = (math.log10(edge(values)) for edge in (min, max))
    return lambda value: start + (math.log10(value) - low) / ((high - low) or 1) * (end - start)


def _short(number: float) -> str:
    power = int(math.log10(number)) // 3 if number >= 10_000 else 0
    return f"{number / 1000**power:.3g}" + ("", "k", "M")[power]


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks growth", description=__doc__)
    add = parser.add_argument
    add("--sizes", nargs="+", type=int, default=[1, 4, 16, 64, 256, 1024, 4096])
    add("--bytes", nargs="+", type=int, default=[10**power for power in range(2, 8)])
    add("--processes", nargs="+", type=int, default=[1, 2, 4, 8, 16, 32, 64])
    add("--rounds", type=int, default=7)
    add("--seconds", type=float, default=0.1, help="of each turn")
    add("--nice", type=int, default=0, help="-20: on a machine that others use")
    add("--plot", type=Path, help="the SVG to write")
    return parser


if __name__ == "__main__":
    main()
