"""A report as one page for people: HTML that needs nothing else, and runs nothing.

Its texts are partly a stranger's. All of them go through ``_text``, which leaves no character that
HTML gives a meaning to, and the page's own policy forbids scripts, links to elsewhere, and forms.
"""

from __future__ import annotations

import html
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

from envhub_sandbox.check.findings import Finding, Report
from envhub_sandbox.check.table import CHECKS
from envhub_worker.protocol.text import printable

_LONGEST = 1_000
_MOST_ROWS = 2_000
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
_STYLE = """
:root { color-scheme: light dark }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 70rem; padding: 0 1rem }
h1 { font-size: 1.4rem; overflow-wrap: anywhere }
h2 { font-size: 1.1rem; margin-top: 2rem }
table { border-collapse: collapse; width: 100% }
th, td { border-bottom: 1px solid #8884; overflow-wrap: anywhere; padding: .3rem .6rem .3rem 0;
  text-align: left; vertical-align: top }
.error { color: #c22 } .warning { color: #a60 } .note { color: #777 } .passed { color: #182 }
.cure { color: #777; display: block }
""".strip()
_UNITS = {"_s": ("ms", 1e3, 2), "_bytes": ("MiB", 2.0**-20, 1)}


def page(report: Report, failures: Collection[Finding]) -> str:
    """The whole page. Trust: whatever stands in a report may be a stranger's text."""
    body = [*_head(report, failures), *_findings(report, failures), *_figures(report)]
    body += [*_held(report), *_provenance(report.provenance or {})]
    return "\n".join(
        [
            '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<meta name="referrer" content="no-referrer">',
            f"<title>envhub check: {_text(report.reference)}</title>",
            f"<style>\n{_STYLE}\n</style>\n</head>\n<body>",
            *body,
            "</body>\n</html>\n",
        ]
    )


def _text(value: object) -> str:
    """Text, and nothing but text: in a page as in an attribute of it."""
    return html.escape(printable(str(value), _LONGEST), quote=True)


def _head(report: Report, failures: Collection[Finding]) -> Iterator[str]:
    style, verdict = ("error", f"{len(failures)} findings fail") if failures else ("passed",) * 2
    yield f"<h1>{_text(report.reference)}</h1>"
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
        cure = f'<span class="cure">{_text(one.check.cure)}</span>'
        cells = (_text(one.id), _text(one.task), f"{_text(one.text)}{cure}")
        rows.append((f'<span class="{severity}">{mark}</span>', *cells))
    yield from _table(("", "check", "task", "what was seen, and what cures it"), rows)


def _figures(report: Report) -> Iterator[str]:
    if not report.figures:
        return
    names = list(dict.fromkeys(name for row in report.figures.values() for name in row))
    yield "<h2>Figures</h2>"
    rows = [
        (_text(task), *(_figure(name, row.get(name)) for name in names))
        for task, row in report.figures.items()
    ]
    yield from _table(("task", *(_text(name) for name in names)), rows)


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
        (_text(check), _text(CHECKS[check].sentence), _text(", ".join(filter(None, of))))
        for check, of in tasks.items()
    ]
    yield from _table(("check", "what holds", "tasks"), rows)


def _provenance(provenance: Mapping[str, Any]) -> Iterator[str]:
    if not provenance:
        return
    yield "<h2>What ran</h2>"
    names = ("repository", "repo_type", "commit", "path", "protocol")
    rows = [(_text(name), _text(provenance.get(name))) for name in names]
    for name in ("interpreter", "packages"):
        told = provenance.get(name)
        if isinstance(told, Mapping):  # Trust: the worker's own words
            words = ", ".join(f"{key} {value}" for key, value in list(told.items())[:_MOST_ROWS])
            rows.append((f"{name}, as it says", _text(words)))
    yield from _table(("", ""), rows)
    layers = [
        tuple(_text(layer.get(name)) for name in ("layer", "enforced", "detail"))
        for layer in provenance.get("layers") or ()
    ]
    yield from _table(("layer", "holds", "how"), layers)


def _table(heads: Iterable[str], rows: Collection[tuple[str, ...]]) -> Iterator[str]:
    """A table of cells that are HTML already."""
    yield "<table>\n<tr>" + "".join(f"<th>{head}</th>" for head in heads) + "</tr>"
    for row in list(rows)[:_MOST_ROWS]:
        yield "<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>"
    yield "</table>"
    if len(rows) > _MOST_ROWS:
        yield f"<p>{len(rows) - _MOST_ROWS} more are left out.</p>"
