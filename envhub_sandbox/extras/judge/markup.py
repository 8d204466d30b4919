"""Builds pages for people: escaped text, tables and plots, without scripts.

All of a stranger's text goes through ``text``, which escapes every character with a meaning in
HTML. The page's own policy forbids scripts and all content from elsewhere.
"""

from __future__ import annotations

import base64
import hashlib
import html
import math
from collections.abc import Collection, Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from envhub_worker.protocol.text import duration_text, printable, size_text

_LONGEST = 1_000
_MOST_ROWS = 2_000
_STYLE = """
:root { color-scheme: light dark; --ground: #f6f5f2; --sheet: #fff; --ink: #1c2024; --dim: #62676e;
  --rule: #1c202420; --bar: #3b6fd4; --area: #3b6fd426; --mark: #b4552d;
  --error: #b3261e; --warning: #8a5a00; --note: #5b6168; --passed: #1b6e3c }
@media (prefers-color-scheme: dark) { :root { --ground: #14161a; --sheet: #1d2026; --ink: #e6e6e3;
  --dim: #9aa0a8; --rule: #e6e6e326; --bar: #7da7f5; --area: #7da7f530; --mark: #f0a37c;
  --error: #ff8a80; --warning: #f2c14e; --note: #a8aeb6; --passed: #7fd49b } }
* { box-sizing: border-box }
body { background: var(--ground); color: var(--ink); font: 15px/1.5 system-ui, sans-serif;
  margin: 0 auto; max-width: 72rem; padding: 1.5rem clamp(.75rem, 3vw, 2rem) 3rem }
h1, h2, h3, p, td, th, dd, li, summary { overflow-wrap: anywhere }
h1 { font-size: 1.35rem; line-height: 1.3; margin: .4rem 0 }
h2 { font-size: 1.1rem; margin: 2.2rem 0 .7rem }
h3 { font-size: .95rem; margin: 0 0 .4rem }
p { margin: .4rem 0 }
code, .mono { font-family: ui-monospace, monospace; font-size: .88em }
.sheet { background: var(--sheet); border: 1px solid var(--rule); border-radius: .6rem;
  margin: .8rem 0; padding: .9rem 1.1rem }
.badge { border: 1px solid; border-radius: 9rem; display: inline-block; font-size: .8rem;
  font-weight: 600; padding: .05rem .7rem; white-space: nowrap }
.error { color: var(--error) } .warning { color: var(--warning) }
.note { color: var(--note) } .passed { color: var(--passed) }
.dim, .cure { color: var(--dim) } .cure { display: block }
.wide { overflow-x: auto }
table { border-collapse: collapse; width: 100% }
th, td { border-bottom: 1px solid var(--rule); padding: .35rem .9rem .35rem 0; text-align: left;
  vertical-align: top }
th { color: var(--dim); font-size: .85rem; font-weight: 600; white-space: nowrap }
.whole { white-space: nowrap }
tr:last-child td { border-bottom: 0 }
.findings { list-style: none; margin: 0; padding: 0 }
.findings li { border-left: .25rem solid; margin: .7rem 0; padding: .1rem 0 .1rem .8rem }
.findings p { color: var(--ink); white-space: pre-line }
dl { display: grid; gap: .1rem 1.2rem; grid-template-columns: max-content 1fr; margin: .5rem 0 }
dt { color: var(--dim) } dd { margin: 0 }
summary { cursor: pointer; margin: .8rem 0 }
figure { margin: 0 } figcaption { color: var(--dim); font-size: .85rem }
figcaption strong { color: var(--ink) }
.plots { display: grid; gap: 1.2rem 1.6rem; grid-template-columns: repeat(auto-fill,
  minmax(min(100%, 22rem), 1fr)); margin: 1rem 0 .4rem }
.pictures { display: grid; gap: .8rem 1.2rem; grid-template-columns: repeat(auto-fit,
  minmax(min(100%, 17rem), 1fr)); margin: 1rem 0 }
.pictures video, .pictures img { background: var(--ground); border-radius: .4rem; display: block;
  height: auto; max-height: 20rem; max-width: 100%; object-fit: contain; width: 100% }
.stills { align-content: start; display: grid; gap: .6rem; grid-template-columns: 1fr 1fr }
.stills img { max-height: 9.6rem }
svg { display: block; height: auto; width: 100% }
svg text { fill: var(--dim); font: 12px system-ui, sans-serif }
.bar { fill: var(--bar) } .area { fill: var(--area) }
.line { fill: none; stroke: var(--bar); stroke-width: 1.6 }
.grid { stroke: var(--rule) } .mark { stroke: var(--mark); stroke-dasharray: 3 3 }
@media (max-width: 34rem) { dl { grid-template-columns: 1fr } dd { margin-bottom: .5rem }
  table, tbody, tr, td { display: block } tr { border-bottom: 1px solid var(--rule);
  padding: .6rem 0 } td { border: 0; padding: .1rem 0 } td:empty, tr:has(th) { display: none }
  td::before { color: var(--dim); content: attr(data-head) " "; font-size: .85rem } }
"""
_HASH = base64.b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode()
_POLICY = (
    f"default-src 'none'; style-src 'sha256-{_HASH}'; img-src data:; media-src data:; "
    "base-uri 'none'; form-action 'none'"
)
"""The page's permissions: a stranger's markup, if any got in, could not even change its style."""


def markup_page(title: str, body: Iterable[str]) -> str:
    """Returns a whole page in one file; the body is our HTML, the title may be a stranger's."""
    return "\n".join(
        [
            '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<meta name="referrer" content="no-referrer">',
            f"<title>{text(title)}</title>",
            f"<style>{_STYLE}</style>\n</head>\n<body>",
            *body,
            "</body>\n</html>\n",
        ]
    )


def text(value: object, limit: int = _LONGEST) -> str:
    """Escapes a value as plain text, for a page or for an attribute."""
    return html.escape(printable(str(value), limit), quote=True)


def data(kind: str, content: bytes) -> str:
    """Returns our bytes as a data URL: the page shows no other URLs."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def facts(rows: Iterable[tuple[object, object]], limit: int = _LONGEST) -> Iterator[str]:
    """Yields a list of names and values; both may be a stranger's."""
    yield "<dl>"
    for name, value in rows:
        yield f"<dt>{text(name, limit)}</dt><dd>{text(value, limit)}</dd>"
    yield "</dl>"


def folded(summary: str, inside: Iterable[str]) -> Iterator[str]:
    """Yields HTML that the reader can unfold."""
    yield f"<details><summary>{text(summary)}</summary>"
    yield from inside
    yield "</details>"


def table(heads: Iterable[str], rows: Collection[tuple[str, ...]]) -> Iterator[str]:
    """Yields a table of HTML cells, limited to the rows that a browser can handle.

    On a phone each row is a paragraph, with the column's head before each cell.
    """
    names = [text(head) for head in heads]
    top = "".join(f"<th>{name}</th>" for name in names)
    yield f'<div class="wide"><table>\n<tr>{top}</tr>'
    for row in list(rows)[:_MOST_ROWS]:
        cells = zip(names, row, strict=True)
        yield "<tr>" + "".join(f'<td data-head="{name}">{cell}</td>' for name, cell in cells)
    yield "</table></div>"
    if len(rows) > _MOST_ROWS:
        yield f"<p>{len(rows) - _MOST_ROWS} more are left out.</p>"


# --- plots as SVG, which contain only numbers ----------------------------------------------------

_WIDTH, _HEIGHT = 460, 150
_LEFT, _RIGHT, _TOP, _BOTTOM = 6, 6, 18, 20
_WIDEST = 40
_MOST_BARS = 64
_BINS = 32
_LARGEST = 1e100
"""The limit of drawn values: a difference of the largest floats overflows."""


def bar_plot(name: str, values: Sequence[float]) -> str:
    """Draws one bar per finite number, from zero; averages neighbours if there are too many."""
    numbers = finite(values)
    if not len(numbers):
        return ""
    each = -(-len(numbers) // _MOST_BARS)
    groups = [numbers[at : at + each] for at in range(0, len(numbers), each)]
    heights = [float(np.mean(group)) for group in groups]
    low, high = _range([0.0, *heights])
    wide = min((_WIDTH - _LEFT - _RIGHT) / len(heights), _WIDEST)
    shown = []
    for index, value in enumerate(heights):
        top, base = sorted((_y(value, low, high), _y(0.0, low, high)))
        first, last = index * each + 1, min((index + 1) * each, len(numbers))
        caption = f"{first}" if each == 1 else f"mean of {first} to {last}"
        box = (_LEFT + (index + 0.1) * wide, top, max(0.8 * wide, 0.5), max(base - top, 1.0))
        shown.append(_bar(box, f"{caption}: {number(value)}"))
    marks = [*_level(high, low, high), *_level(low, low, high)]
    foot = f"{len(numbers)}" if each == 1 else f"{len(numbers)}, mean of {each} each"
    feet = [(0.5, "1"), (len(heights) - 0.5, foot)] if len(numbers) > 1 else []
    ends = [(at * wide / (_WIDTH - _LEFT - _RIGHT), word) for at, word in feet]
    return _svg(name, [*shown, *marks, *_below(ends)])


def histogram_plot(name: str, seconds: Sequence[float]) -> str:
    """Draws the distribution of durations in logarithmic bins, with median and 99th percentile."""
    numbers = np.maximum(finite(seconds), 1e-7)
    if not len(numbers):
        return ""
    bins = min(_BINS, max(3, len(numbers) // 2))  # few values need wide bins
    edges = np.geomspace(numbers.min() / 1.05, numbers.max() * 1.05, bins + 1)
    counts, _ = np.histogram(numbers, edges)
    wide, most = (_WIDTH - _LEFT - _RIGHT) / bins, float(counts.max())
    shown = []
    for index, count in enumerate(counts.tolist()):
        if count:
            top = _y(count, 0.0, most)
            box = (_LEFT + (index + 0.05) * wide, top, 0.9 * wide, _y(0.0, 0.0, most) - top)
            span = f"{duration_text(edges[index])} to {duration_text(edges[index + 1])}"
            shown.append(_bar(box, f"{span}: {count}"))
    length = math.log(edges[-1] / edges[0])
    for share, word in ((0.5, "median"), (0.99, "99 %")):
        value = float(np.quantile(numbers, share))
        at = _x(math.log(value / edges[0]) / length)
        anchor = "end" if at > _WIDTH / 2 else "start"
        aside = -4 if anchor == "end" else 4
        shown.append(_line(at, _TOP - 4, at, _HEIGHT - _BOTTOM, "mark"))
        shown.append(_word(at + aside, _TOP - 4 + (0 if share < 0.9 else 12), word, anchor))
    ends = [(0.0, duration_text(edges[0])), (1.0, duration_text(edges[-1]))]
    return _svg(name, [*shown, *_below(ends)])


def line_plot(name: str, values: Sequence[float], parts: Sequence[tuple[int, str]]) -> str:
    """Draws numbers of bytes as a line; ``parts``: number of values and label of each part."""
    numbers = finite(values)
    if len(numbers) < 2 or len(numbers) != len(values):
        return ""
    low, high = _range([0.0, *numbers.tolist()])  # from zero: small changes look small
    last = len(numbers) - 1
    points = [(_x(at / last), _y(value, low, high)) for at, value in enumerate(numbers.tolist())]
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
        if count and share > ends[-1][0] + 0.15:  # else the label would overlap the previous one
            ends.append((share, word))
            if share < 1:
                shown.append(_line(_x(share), _TOP, _x(share), _HEIGHT - _BOTTOM, "mark"))
    highest = size_text(float(numbers.max()))
    shown.append(_word(_LEFT, _TOP - 5, f"up to {highest}", "start"))
    return _svg(name, [*shown, *_below(ends)])


def number(value: float) -> str:
    """Formats a number in few characters."""
    if not math.isfinite(value):
        return "none"
    if 1_000 <= abs(value) < 1e6:
        return f"{value:,.0f}"
    return f"{value:.3g}"


def finite(values: Sequence[float]) -> NDArray[np.float64]:
    """Returns the finite values, clipped so that their differences are finite."""
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
    """Draws a horizontal line at a value, and the number above it."""
    y = _y(value, low, high)
    yield _line(_LEFT, y, _WIDTH - _RIGHT, y, "grid")
    if value > 0:
        yield _word(_LEFT, y - 4, number(value), "start")
    elif value:  # at the right end: few bars begin at the left
        yield _word(_WIDTH - _RIGHT, y - 3, number(value), "end")


def _below(words: Sequence[tuple[float, str]]) -> Iterator[str]:
    """Draws the labels under a plot: at the left end, at the right end, or between."""
    for share, word in words:
        anchor = "start" if share <= 0.02 else "end" if share >= 0.98 else "middle"
        yield _word(_x(share), _HEIGHT - 4, word, anchor)


def _svg(name: str, inside: Sequence[str]) -> str:
    box = f'viewBox="0 0 {_WIDTH} {_HEIGHT}"'
    return f'<svg {box} role="img" aria-label="{name}">{"".join(inside)}</svg>'
