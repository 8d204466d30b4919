"""Renders a report as one self-contained HTML page without scripts.

Its texts are partly a stranger's and all go through ``markup.text``. This module makes its pictures
and plots from numbers.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from envhub_sandbox.extras.judge.checks import CHECKS
from envhub_sandbox.extras.judge.findings import Finding, Report
from envhub_sandbox.extras.judge.markup import (
    bar_plot,
    data,
    facts,
    finite,
    folded,
    histogram_plot,
    line_plot,
    markup_page,
    number,
    table,
    text,
)
from envhub_sandbox.extras.judge.play.film import Film, Play
from envhub_worker.protocol.text import counted, duration_text, size_text

_MOST_PAIRS, _LONGEST_WORD = 1_000, 160
"""Files or packages to list, each with its value."""
_MOST_TASKS = 40
"""Tasks to show with more than a line."""
_MOST_PICTURES = 12 << 20
"""Bytes of all pictures and films together."""
_RAN = ("repository", "repo_type", "commit", "path", "protocol")


def page(report: Report, failures: Collection[Finding]) -> str:
    """Returns the whole page. Trust: a report's texts may be a stranger's."""
    body = [*_head(report, failures), *_findings(report, failures), *_tasks(report)]
    body += [*_figures(report), *_held(report), *_judged(report), *_ran(report.provenance or {})]
    return markup_page(f"envhub check: {report.reference}", body)


def _head(report: Report, failures: Collection[Finding]) -> Iterator[str]:
    style, verdict = "passed", "passed"
    if failures:
        style, verdict = "error", f"failed by {counted(len(failures), 'finding')}"
    if report.is_unjudged(failures):
        style, verdict = "warning", "not judged to its end"
    yield f'<p class="dim">envhub check <span class="badge {style}">{verdict}</span></p>'
    yield f"<h1>{text(report.reference)}</h1>"
    left_out = f"; {report.left_out} of them are left out here" if report.left_out else ""
    when = f" Judged at {report.asked['judged at']}." if "judged at" in report.asked else ""
    yield f'<p class="dim">{text(report.verdict(failures) + left_out + "." + when)}</p>'


def _findings(report: Report, failures: Collection[Finding]) -> Iterator[str]:
    if not report.findings:
        return
    yield '<h2>Findings</h2>\n<ul class="findings">'
    for finding in report.findings:
        severity = finding.check.severity.value
        mark = f"{severity}, fails it" if finding in failures else severity
        where = f' <span class="dim">{text(finding.task)}</span>' if finding.task else ""
        badge = f'<span class="badge">{mark}</span>'
        yield f'<li class="{severity}">{badge} <code>{finding.id}</code>{where}'
        yield f'<p>{text(finding.text)}</p><span class="cure">{text(finding.cure)}</span></li>'
    yield "</ul>"


def _tasks(report: Report) -> Iterator[str]:
    if not report.plays:
        return
    yield "<h2>Tasks</h2>"
    left = _MOST_PICTURES
    for name, play in list(report.plays.items())[:_MOST_TASKS]:
        yield f'<section class="sheet"><h3>{text(name)}</h3>'
        if play.film is not None:
            shown, left = _fitting(play.film, left)
            yield from _pictures(shown)
        yield from _plots(play)
        yield from facts(play.facts.items())
        yield "</section>"
    if len(report.plays) > _MOST_TASKS:
        yield f'<p class="dim">{len(report.plays) - _MOST_TASKS} more have a line below.</p>'


def _fitting(film: Film, left: int) -> tuple[Film, int]:
    """Returns the part of a film that fits the page, and the bytes that remain."""
    stills = sum(map(len, film.stills))
    size = stills + len(film.video)
    if size <= left:
        return film, left - size
    too_large = "this page would be too large with its film"
    if stills <= left:
        return Film(film.stills, frames=film.frames, lacks=too_large), left - stills
    return Film(frames=film.frames, lacks=too_large), left


def _pictures(film: Film) -> Iterator[str]:
    yield '<div class="pictures">'
    if film.video:
        source = data("video/mp4", film.video)
        yield f'<figure><video controls loop muted playsinline src="{source}"></video>'
        frames = f"{counted(film.frames, 'frame')}, {number(film.fps)} a second"
        yield f"<figcaption>{frames}</figcaption></figure>"
    yield '<div class="stills">'
    for index, still in enumerate(film.stills):
        alt = f"rendered frame {index + 1} of {len(film.stills)}"
        yield f'<img alt="{alt}" src="{data("image/png", still)}">'
    yield "</div></div>"
    if film.lacks:
        title = "The film ends early" if film.video else "No film" if film.stills else "No picture"
        yield f'<p class="dim">{title}: {text(film.lacks)}</p>'


def _plots(play: Play) -> Iterator[str]:
    returns = [episode.returns[0] for episode in play.episodes]
    lengths = [float(episode.length) for episode in play.episodes]
    times = play.step_s
    parts = [(play.played, "played"), (len(play.memory) - play.played, "resets")]
    many = len(play.episodes[0].returns) if play.episodes else 1
    of = f"Return, component 1 of {many}" if many > 1 else "Return"
    drawn = [
        _plot(f"{of}, per episode", _mean(returns), bar_plot(f"{of} of each episode", returns)),
        _plot("Length of episodes", _mean(lengths), bar_plot("Length of each episode", lengths)),
        _plot(
            "Time of a step",
            f"median {duration_text(float(np.median(times)))}" if times else "",
            histogram_plot("Times of steps", times),
        ),
        _plot("Memory", "", line_plot("Memory of its processes", play.memory, parts)),
    ]
    if not play.episodes and play.step_s:
        yield '<p class="dim">No episode ended while it was played: see --steps.</p>'
    if play.episodes and not drawn[0]:
        yield '<p class="dim">No return is a finite number.</p>'
    if any(drawn):
        yield f'<div class="plots">{"".join(drawn)}</div>'


def _plot(name: str, figure: str, svg: str) -> str:
    if not svg:
        return ""
    strong = f" <strong>{figure}</strong>" if figure else ""
    return f"<figure><figcaption>{name}{strong}</figcaption>{svg}</figure>"


def _mean(values: Sequence[float]) -> str:
    numbers = finite(values)
    return f"mean {number(float(np.mean(numbers)))}" if len(numbers) else ""


def _figures(report: Report) -> Iterator[str]:
    if not report.figures:
        return
    names = list(dict.fromkeys(name for row in report.figures.values() for name in row))
    heads = (name.removesuffix("_s").removesuffix("_bytes").replace("_", " ") for name in names)
    yield "<h2>Figures</h2>"
    rows = [
        (text(task), *(_figure(name, row.get(name)) for name in names))
        for task, row in report.figures.items()
    ]
    yield from table(("task", *heads), rows)


def _figure(name: str, value: float | None) -> str:
    if value is None:
        return ""
    if name.endswith("_bytes"):
        return size_text(value)
    return duration_text(value) if name.endswith("_s") else f"{value:g}"


def _held(report: Report) -> Iterator[str]:
    tasks: dict[str, list[str]] = {}
    for check, task in report.passed:
        tasks.setdefault(check, []).append(task)
    rows = [
        (f"<code>{check}</code>", text(CHECKS[check].sentence), text(", ".join(filter(None, of))))
        for check, of in tasks.items()
    ]
    yield "<h2>Checks that hold</h2>"
    title = counted(len(rows), "check holds", "checks hold")
    yield from folded(title, table(("check", "what holds", "tasks"), rows))


def _judged(report: Report) -> Iterator[str]:
    if report.asked:
        walls = () if report.confinement is None else report.confinement.lines()
        yield "<h2>How it was judged</h2>"
        yield from facts([*report.asked.items(), *(("confined by", line) for line in walls)])


def _ran(provenance: Mapping[str, Any]) -> Iterator[str]:
    if not provenance:
        return
    yield "<h2>What ran</h2>"
    interpreter = _pairs(provenance.get("interpreter"))
    says = [(f"{name}, as it says", value) for name, value in interpreter]
    yield from facts([*((name, provenance.get(name)) for name in _RAN), *says])
    listed = provenance.get("layers") or ()
    held = sum(row.get("enforced") is True for row in listed)
    layers = [
        tuple(text(row.get(name)) for name in ("layer", "enforced", "detail")) for row in listed
    ]
    yield from folded(
        f"layers that confined it ({held} of {len(layers)})",
        table(("layer", "holds", "how"), layers),
    )
    for name, said in (
        ("files", "files, by their hashes"),
        ("installed", "packages, installed as it declares"),
        ("packages", "packages that it had, as it says"),
    ):
        pairs = _pairs(provenance.get(name))
        if pairs:
            yield from folded(f"{said} ({len(pairs)})", facts(pairs[:_MOST_PAIRS], _LONGEST_WORD))


def _pairs(value: object) -> list[tuple[str, Any]]:
    """Returns the items of a mapping. Trust: the worker's own words."""
    return list(value.items()) if isinstance(value, Mapping) else []
