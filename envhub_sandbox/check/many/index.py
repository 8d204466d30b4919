"""All results in one page, one document, one JUnit file, and what GitHub shows of them.

References are the caller's words; why one could not be judged is partly a stranger's text. It is
escaped as in the page of one report, and no address is made of it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any
from xml.etree import ElementTree

from envhub_sandbox.check import markup, reports
from envhub_sandbox.check.findings import Finding, Report
from envhub_sandbox.check.many.lines import Listed
from envhub_sandbox.check.many.results import Result, Verdict, link
from envhub_sandbox.check.table import Severity
from envhub_worker.protocol.text import printable

_FORMAT = 1
_LONGEST = 500
_SHORT = 18
"""Characters of a commit that people compare."""
_REFERENCE = '<span class="broad">reference</span>'
_HEADS = ("", _REFERENCE, "commit", "error", "warning", "note", "seconds", "judged")
_STYLES = {
    Verdict.FAILED: "error",
    Verdict.UNJUDGED: "warning",
    Verdict.WAITING: "note",
    Verdict.PASSED: "passed",
}


def document(results: Iterable[Result]) -> dict[str, Any]:
    """Everything, as plain data, in the order of the list."""
    rows = [_row(one) for one in results]
    return {"format": _FORMAT, "counts": _counts(row["verdict"] for row in rows), "results": rows}


def _counts(verdicts: Iterable[str]) -> dict[str, int]:
    found = Counter(verdicts)
    return {one.value: found[one.value] for one in Verdict}


def _row(one: Result) -> dict[str, Any]:
    return {
        "reference": one.listed.reference,
        "line": one.listed.line,
        "verdict": one.verdict.value,
        "commit": one.commit or None,
        "findings": {level.value: (one.found or {}).get(level.value, 0) for level in Severity}
        if one.is_judged
        else None,
        "fails": list(one.fails),
        "seconds": round(one.seconds, 3),
        "judged": one.ended or None,
        "said": printable(one.said, _LONGEST) or None,
        "report": link(one.listed, "json") if one.is_judged else None,
        "page": link(one.listed, "html") if one.is_judged else None,
    }


def page(results: Sequence[Result]) -> str:
    """One page that needs nothing else and runs nothing: what fails comes first."""
    order = list(Verdict)
    title = f"envhub check: {told(results)}"
    rows = [_cells(one) for one in sorted(results, key=lambda one: order.index(one.verdict))]
    return markup.document(title, [f"<h1>{title}</h1>", *markup.table(_HEADS, rows)])


def told(results: Iterable[Result]) -> str:
    """How many there are of each verdict."""
    counts = _counts(one.verdict.value for one in results)
    return ", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)


def _cells(one: Result) -> tuple[str, ...]:
    """A row of HTML: a link leads to a file whose name is ours."""
    reference, why = markup.text(one.listed.reference), ", ".join(one.fails) or one.said
    if one.is_judged:
        reference = f'<a href="{markup.text(link(one.listed, "html"))}">{reference}</a>'
    said = f'<span class="cure">{markup.text(printable(why, _LONGEST))}</span>' if why else ""
    found = one.found or {}
    return (
        f'<span class="whole {_STYLES[one.verdict]}">{one.verdict.value}</span>',
        f"{reference}{said}",
        f'<span class="mono">{markup.text(one.commit[:_SHORT])}</span>',
        *(f"{found.get(level.value, 0)}" if one.is_judged else "" for level in Severity),
        f"{one.seconds:.1f}" if one.ended else "",
        f'<span class="whole">{markup.text(one.ended)}</span>',
    )


def junit(
    results: Iterable[Result], report: Callable[[Listed], tuple[Report, list[Finding]] | None]
) -> str:
    """A suite for each reference: its checks as test cases, or why there are none as an error.

    Args:
        results: In the order of the list.
        report: What was kept of a reference.
    """
    root = ElementTree.Element("testsuites", name="envhub check")
    for one in results:
        found = report(one.listed) if one.is_judged else None
        made = _unjudged(one) if found is None else reports.suite(*found)
        made.set("time", f"{one.seconds:.3f}")
        root.append(made)
    for name in ("tests", "failures", "errors"):
        root.set(name, str(sum(int(made.attrib[name]) for made in root)))
    return reports.xml(root)


def _unjudged(one: Result) -> ElementTree.Element:
    name = reports.xml_text(printable(one.listed.reference, _LONGEST))
    made = ElementTree.Element(
        "testsuite", name=name, tests="1", failures="0", errors="1", skipped="0"
    )
    case = ElementTree.SubElement(made, "testcase", classname="repository", name="judged")
    error = ElementTree.SubElement(case, "error", message=one.verdict.value)
    error.text = reports.xml_text(printable(one.said, _LONGEST))
    return made


def workflow_commands(results: Iterable[Result]) -> Iterator[str]:
    """One of GitHub's annotations for each reference that did not pass."""
    for one in results:
        if one.verdict is not Verdict.PASSED:
            words = ", ".join(one.fails) or printable(one.said, _LONGEST) or one.verdict.value
            title = f"envhub check: {printable(one.listed.reference, _LONGEST)}"
            yield reports.workflow_command("error", title, f"{one.verdict.value}: {words}")


def summary(results: Sequence[Result]) -> str:
    """A table for GitHub's step summary; a stranger's text is no markup there."""
    lines = [f"### envhub check: {told(results)}", "", "| | reference | |", "| --- | --- | --- |"]
    for one in results:
        why = ", ".join(one.fails) or printable(one.said, _LONGEST)
        cells = (printable(one.listed.reference, _LONGEST), why)
        lines.append(f"| {one.verdict.value} | {' | '.join(map(reports.cell, cells))} |")
    return "\n".join(lines) + "\n"
