"""All results in one page, one document, one JUnit file, and what GitHub shows of them.

References are the caller's words; why one could not be judged is partly a stranger's text. It is
escaped as in the page of one report, and no address is made of it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any
from xml.etree import ElementTree

from envhub_sandbox.check import markup, reports
from envhub_sandbox.check.checks import Severity
from envhub_sandbox.check.findings import Finding, Report
from envhub_sandbox.check.many.entries import ListEntry
from envhub_sandbox.check.many.results import Result, Verdict, link
from envhub_worker.protocol.text import counted, duration_text, printable

_FORMAT = 1
_LONGEST = 500
_SHORT = 18
"""Characters of a commit that people compare."""
_HEADS = ("verdict", "repository", "findings", "took", "judged", "commit")
_LEVELS = [level.value for level in Severity]
_STYLES = {
    Verdict.FAILED: "error",
    Verdict.UNJUDGED: "warning",
    Verdict.WAITING: "note",
    Verdict.PASSED: "passed",
}


def index_document(results: Iterable[Result]) -> dict[str, Any]:
    """Everything, as plain data."""
    found = ordered(results)
    rows = [_row(one) for one in found]
    return {"format": _FORMAT, "counts": _counts(found), "results": rows}


def ordered(results: Iterable[Result]) -> list[Result]:
    """What fails, then what could not be judged; those of one verdict as the list has them."""
    order = list(Verdict)
    return sorted(results, key=lambda one: order.index(one.verdict))


def _counts(results: Iterable[Result]) -> dict[str, int]:
    found = Counter(one.verdict for one in results)
    return {one.value: found[one] for one in Verdict}


def _row(one: Result) -> dict[str, Any]:
    found = one.found
    return {
        "reference": one.listed.reference,
        "line": one.listed.line,
        "verdict": one.verdict.value,
        "commit": one.commit or None,
        "findings": None if found is None else {name: found.get(name, 0) for name in _LEVELS},
        "fails": list(dict.fromkeys(check for check, _ in one.fails)),
        "why": one.why,
        "seconds": round(one.seconds, 3),
        "judged": one.ended or None,
        "said": printable(one.said, _LONGEST) or None,
        "report": link(one.listed, "json") if one.has_report else None,
        "page": link(one.listed, "html") if one.has_report else None,
    }


def page(results: Sequence[Result]) -> str:
    """One page that needs nothing else and runs nothing."""
    title = f"envhub check: {counts(results)}"
    rows = [_cells(one) for one in ordered(results)]
    return markup.markup_page(title, [f"<h1>{title}</h1>", *markup.table(_HEADS, rows)])


def counts(results: Iterable[Result]) -> str:
    """How many there are of each verdict, in words."""
    return ", ".join(f"{count} {verdict}" for verdict, count in _counts(results).items() if count)


def _cells(one: Result) -> tuple[str, ...]:
    """A row of HTML: a link leads to a file whose name is ours."""
    reference = markup.text(one.listed.reference)
    if one.has_report:
        reference = f'<a href="{markup.text(link(one.listed, "html"))}">{reference}</a>'
    why = "".join(f'<span class="cure">{markup.text(line)}</span>' for line in one.why)
    found: Mapping[str, int] = one.found or {}
    levels = [counted(found[level], level) for level in _LEVELS if found.get(level)]
    return (
        f'<span class="whole {_STYLES[one.verdict]}">{one.verdict.value}</span>',
        f"<strong>{reference}</strong>{why}",
        ", ".join(levels) or ("none" if one.has_report else ""),
        f'<span class="whole">{duration_text(one.seconds)}</span>' if one.ended else "",
        f"{markup.text(one.ended[:16].replace('T', ' '))} UTC" if one.ended else "",
        f'<span class="mono">{markup.text(one.commit[:_SHORT])}</span>' if one.commit else "",
    )


def junit(
    results: Iterable[Result], report: Callable[[ListEntry], tuple[Report, list[Finding]] | None]
) -> str:
    """A suite for each reference: its checks as test cases, or why there are none as an error."""
    root = ElementTree.Element("testsuites", name="envhub check")
    for one in ordered(results):
        found = report(one.listed) if one.has_report else None
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
    for one in ordered(results):
        if one.verdict is not Verdict.PASSED:
            words = "\n".join([one.verdict.value, *one.why])
            title = f"envhub check: {printable(one.listed.reference, _LONGEST)}"
            yield reports.workflow_command("error", title, words)


def summary(results: Sequence[Result]) -> str:
    """A table for GitHub's step summary; a stranger's text is no markup there."""
    lines = [f"### envhub check: {counts(results)}", "", "| | reference | |", "| --- | --- | --- |"]
    for one in ordered(results):
        cells = (printable(one.listed.reference, _LONGEST), "; ".join(one.why))
        lines.append(f"| {one.verdict.value} | {' | '.join(map(reports.cell, cells))} |")
    return "\n".join(lines) + "\n"
