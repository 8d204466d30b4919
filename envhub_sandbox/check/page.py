"""A report as one page for people: HTML that needs nothing else, and runs nothing.

Its texts are partly a stranger's. All of them go through ``markup.text``.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any

from envhub_sandbox.check.findings import Finding, Report
from envhub_sandbox.check.markup import document, table, text
from envhub_sandbox.check.table import CHECKS

_MOST_WORDS = 2_000
_UNITS = {"_s": ("ms", 1e3, 2), "_bytes": ("MiB", 2.0**-20, 1)}


def page(report: Report, failures: Collection[Finding]) -> str:
    """The whole page. Trust: whatever stands in a report may be a stranger's text."""
    body = [*_head(report, failures), *_findings(report, failures), *_figures(report)]
    body += [*_held(report), *_provenance(report.provenance or {})]
    return document(f"envhub check: {report.reference}", body)


def _head(report: Report, failures: Collection[Finding]) -> Iterator[str]:
    style, verdict = ("error", f"{len(failures)} findings fail") if failures else ("passed",) * 2
    yield f"<h1>{text(report.reference)}</h1>"
    yield f'<p class="{style}"><strong>{verdict}</strong></p>'
    left_out = f", {report.left_out} more are left out" if report.left_out else ""
    yield f"<p>{len(report.passed)} checks hold, {len(report.findings)} findings{left_out}.</p>"


def _findings(report: Report, failures: Collection[Finding]) -> Iterator[str]:
    if not report.findings:
        return
    yield "<h2>Findings</h2>"
    rows = []
    for one in report.findings:
        severity = one.check.severity.value
        mark = f"{severity}, fails" if one in failures else severity
        cure = f'<span class="cure">{text(one.check.cure)}</span>'
        cells = (text(one.id), text(one.task), f"{text(one.text)}{cure}")
        rows.append((f'<span class="{severity}">{mark}</span>', *cells))
    yield from table(("", "check", "task", "what was seen, and what cures it"), rows)


def _figures(report: Report) -> Iterator[str]:
    if not report.figures:
        return
    names = list(dict.fromkeys(name for row in report.figures.values() for name in row))
    yield "<h2>Figures</h2>"
    rows = [
        (text(task), *(_figure(name, row.get(name)) for name in names))
        for task, row in report.figures.items()
    ]
    yield from table(("task", *(text(name) for name in names)), rows)


def _figure(name: str, value: float | None) -> str:
    if value is None:
        return ""
    for ending, (unit, factor, digits) in _UNITS.items():
        if name.endswith(ending):
            return f"{value * factor:.{digits}f} {unit}"
    return f"{value:g}"


def _held(report: Report) -> Iterator[str]:
    yield "<h2>Checks that hold</h2>"
    tasks: dict[str, list[str]] = {}
    for check, task in report.passed:
        tasks.setdefault(check, []).append(task)
    rows = [
        (text(check), text(CHECKS[check].sentence), text(", ".join(filter(None, of))))
        for check, of in tasks.items()
    ]
    yield from table(("check", "what holds", "tasks"), rows)


def _provenance(provenance: Mapping[str, Any]) -> Iterator[str]:
    if not provenance:
        return
    yield "<h2>What ran</h2>"
    names = ("repository", "repo_type", "commit", "path", "protocol")
    rows = [(text(name), text(provenance.get(name))) for name in names]
    for name in ("interpreter", "packages"):
        told = provenance.get(name)
        if isinstance(told, Mapping):  # Trust: the worker's own words
            words = ", ".join(f"{key} {value}" for key, value in list(told.items())[:_MOST_WORDS])
            rows.append((f"{name}, as it says", text(words)))
    yield from table(("", ""), rows)
    layers = [
        tuple(text(layer.get(name)) for name in ("layer", "enforced", "detail"))
        for layer in provenance.get("layers") or ()
    ]
    yield from table(("layer", "holds", "how"), layers)
