"""Plots as SVG in a page: all that is drawn is numbers, and all of it is written here."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from envhub_worker.protocol.text import duration_text, size_text

_WIDTH, _HEIGHT = 460, 150
_LEFT, _RIGHT, _TOP, _BOTTOM = 6, 6, 18, 20
_WIDEST = 40
_MOST_BARS = 64
_BINS = 32
_LARGEST = 1e100
"""What is larger is drawn as this: differences of the largest floats are no floats."""


def bar_plot(name: str, values: Sequence[float]) -> str:
    """One bar for each finite number, from zero; of too many, one for the mean of neighbours."""
    known = finite(values)
    if not len(known):
        return ""
    each = -(-len(known) // _MOST_BARS)
    groups = [known[at : at + each] for at in range(0, len(known), each)]
    heights = [float(np.mean(group)) for group in groups]
    low, high = _range([0.0, *heights])
    wide = min((_WIDTH - _LEFT - _RIGHT) / len(heights), _WIDEST)
    shown = []
    for index, value in enumerate(heights):
        top, base = sorted((_y(value, low, high), _y(0.0, low, high)))
        first, last = index * each + 1, min((index + 1) * each, len(known))
        which = f"{first}" if each == 1 else f"mean of {first} to {last}"
        box = (_LEFT + (index + 0.1) * wide, top, max(0.8 * wide, 0.5), max(base - top, 1.0))
        shown.append(_bar(box, f"{which}: {number(value)}"))
    marks = [*_level(high, low, high), *_level(low, low, high)]
    foot = f"{len(known)}" if each == 1 else f"{len(known)}, mean of {each} each"
    return _svg(
        name, [*shown, *marks, *_below([(0.0, "1"), (1.0, foot)] if len(known) > 1 else [])]
    )


def histogram_plot(name: str, seconds: Sequence[float]) -> str:
    """How often something took how long, with logarithmic steps; the median and the 99 %."""
    known = np.maximum(finite(seconds), 1e-7)
    if not len(known):
        return ""
    edges = np.geomspace(known.min() / 1.05, known.max() * 1.05, _BINS + 1)
    counts, _ = np.histogram(known, edges)
    wide, most = (_WIDTH - _LEFT - _RIGHT) / _BINS, float(counts.max())
    shown = []
    for index, count in enumerate(counts.tolist()):
        if count:
            top = _y(count, 0.0, most)
            box = (_LEFT + (index + 0.05) * wide, top, 0.9 * wide, _y(0.0, 0.0, most) - top)
            span = f"{duration_text(edges[index])} to {duration_text(edges[index + 1])}"
            shown.append(_bar(box, f"{span}: {count}"))
    length = math.log(edges[-1] / edges[0])
    for share, word in ((0.5, "median"), (0.99, "99 %")):
        value = float(np.quantile(known, share))
        at = _x(math.log(value / edges[0]) / length)
        anchor = "end" if at > _WIDTH / 2 else "start"
        aside = -4 if anchor == "end" else 4
        shown.append(_line(at, _TOP - 4, at, _HEIGHT - _BOTTOM, "mark"))
        shown.append(_word(at + aside, _TOP - 4 + (0 if share < 0.9 else 12), word, anchor))
    ends = [(0.0, duration_text(known.min())), (1.0, duration_text(known.max()))]
    return _svg(name, [*shown, *_below(ends)])


def line_plot(name: str, values: Sequence[float], parts: Sequence[tuple[int, str]]) -> str:
    """A line through numbers of bytes; ``parts`` are how many, and a word for where they end."""
    known = finite(values)
    if len(known) < 2 or len(known) != len(values):
        return ""
    low, high = _range([0.0, *known.tolist()])  # from zero: no cliff of a thousandth
    last = len(known) - 1
    points = [(_x(at / last), _y(value, low, high)) for at, value in enumerate(known.tolist())]
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    base = f"{_HEIGHT - _BOTTOM:.1f}"
    area = f"{points[0][0]:.1f},{base} {path} {points[-1][0]:.1f},{base}"
    shown = [
        f'<polygon class="area" points="{area}"/>',
        f'<polyline class="line" points="{path}"/>',
    ]
    ends, done = [(0.0, "0")], 0
    for count, word in parts:
        done += count
        share = (done - 1) / last
        if count and share > 0.15:
            ends.append((share, word))
            if share < 1:
                shown.append(_line(_x(share), _TOP, _x(share), _HEIGHT - _BOTTOM, "mark"))
    highest = size_text(float(known.max()))
    shown.append(_word(_LEFT, _TOP - 5, f"up to {highest}", "start"))
    return _svg(name, [*shown, *_below(ends)])


def number(value: float) -> str:
    """A number in few characters."""
    if not math.isfinite(value):
        return "none"
    if 1_000 <= abs(value) < 1e6:
        return f"{value:,.0f}"
    return f"{value:.3g}"


def finite(values: Sequence[float]) -> NDArray[np.float64]:
    """Those that can be drawn, none of them so large that a difference is no number."""
    numbers = np.asarray(values, np.float64).reshape(-1)
    return np.clip(numbers[np.isfinite(numbers)], -_LARGEST, _LARGEST)


def _range(values: Sequence[float]) -> tuple[float, float]:
    low, high = min(values), max(values)
    return (low, high) if high > low else (low, low + 1.0)


def _x(share: float) -> float:
    return _LEFT + share * (_WIDTH - _LEFT - _RIGHT)


def _y(value: float, low: float, high: float) -> float:
    return _TOP + (1 - (value - low) / (high - low)) * (_HEIGHT - _TOP - _BOTTOM)


def _bar(box: tuple[float, float, float, float], title: str) -> str:
    x, y, width, height = box
    return (
        f'<rect class="bar" x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}">'
        f"<title>{title}</title></rect>"
    )


def _line(x1: float, y1: float, x2: float, y2: float, style: str) -> str:
    return f'<line class="{style}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def _word(x: float, y: float, word: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{word}</text>'


def _level(value: float, low: float, high: float) -> Iterator[str]:
    """A line at a height, and its number above it."""
    y = _y(value, low, high)
    yield _line(_LEFT, y, _WIDTH - _RIGHT, y, "grid")
    if value:
        yield _word(_LEFT, y - 4 if value > 0 else y - 3, number(value), "start")


def _below(words: Sequence[tuple[float, str]]) -> Iterator[str]:
    """What stands under the plot: at its left end, at its right end, or between."""
    for share, word in words:
        anchor = "start" if share <= 0.02 else "end" if share >= 0.98 else "middle"
        yield _word(_x(share), _HEIGHT - 4, word, anchor)


def _svg(name: str, inside: Sequence[str]) -> str:
    box = f'viewBox="0 0 {_WIDTH} {_HEIGHT}"'
    return f'<svg {box} role="img" aria-label="{name}">{"".join(inside)}</svg>'
