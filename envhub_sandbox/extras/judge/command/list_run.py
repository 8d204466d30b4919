"""``envhub check --all FILE``: judges a list of repositories one after the other.

Trust: references are the caller's; findings and errors are partly a stranger's text, which each
report format escapes. A run reads no results of earlier runs: their file could be the work of a
listed author.
"""

from __future__ import annotations

import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import typer

from envhub_sandbox.cli.shared import console
from envhub_sandbox.cli.shared.console import safe_line, say, show
from envhub_sandbox.cli.shared.exits import Exit, UsageError
from envhub_sandbox.extras.judge import reports
from envhub_sandbox.extras.judge.command.findings import annotate, write_report
from envhub_sandbox.extras.judge.references import ListEntry, read_entries
from envhub_sandbox.extras.judge.settings import is_in_its_checkout, refuse_files_of_the_judged
from envhub_worker.protocol.errors import EnvHubError
from envhub_worker.protocol.text import duration_text, printable

if TYPE_CHECKING:
    from envhub_sandbox.extras.judge.findings import Finding, Report

_FORMAT = 1
_LONGEST = 500


class Verdict(Enum):
    """The verdict on a reference, worst first."""

    FAILED = "failed"
    UNJUDGED = "not judged"
    PASSED = "passed"


_COLOURS = {Verdict.PASSED: "green", Verdict.FAILED: "red", Verdict.UNJUDGED: "yellow"}


@dataclass(frozen=True, kw_only=True)
class Result:
    """The result for one reference.

    Attributes:
        report: None if there is none; a judgement that meets its deadline has a report.
        failures: The findings that fail the reference.
        error: The reason for a missing judgement. Trust: partly a stranger's text.
    """

    entry: ListEntry
    report: Report | None = None
    failures: Sequence[Finding] = ()
    error: str = ""
    seconds: float = 0.0

    @property
    def verdict(self) -> Verdict:
        """Returns the verdict; only a complete judgement passes."""
        if self.report is None or self.report.is_unjudged(self.failures):
            return Verdict.UNJUDGED
        return Verdict.FAILED if self.failures else Verdict.PASSED

    @property
    def why(self) -> list[str]:
        """Returns the reasons for the verdict, a line for each failed check."""
        lines: dict[str, str] = {}
        for finding in self.failures:
            lines.setdefault(finding.id, f"{finding.id}: {finding.text}")
        return [printable(line, _LONGEST) for line in lines.values() or [self.error] if line]


def judge_list(
    file: str,
    judge: Callable[[str], Report],
    failures_of: Callable[[Report], Sequence[Finding]],
    files: Mapping[str, Path | None],
    *,
    debug: bool,
) -> list[Result]:
    """Judges each repository of a list.

    Args:
        file: The list; ``-`` is stdin.
        files: The caller's files, by option; none may lie in a listed repository.
        debug: Whether to show tracebacks.

    Raises ``UsageError``: the list is unreadable; ``HubReferenceError``: a line is wrong;
    ``PolicyError``: one of the caller's files lies in a listed repository.
    """
    entries, results = _entries(file), []
    for entry in entries:
        refuse_files_of_the_judged(files, entry.reference, f" (line {entry.line} of {file})")
    _warn_of_own_list(file, entries)
    for number, entry in enumerate(entries, 1):
        result = judge_entry(entry, judge, failures_of, debug=debug)
        results.append(result)
        words = f"[{number}/{len(entries)}] {result.verdict.value:<10} {entry.reference}"
        line = "; ".join([words, duration_text(result.seconds), *result.why])
        say(safe_line(line, 300), style=_COLOURS[result.verdict])
    worst_first = list(Verdict)
    return sorted(results, key=lambda result: worst_first.index(result.verdict))


def _entries(file: str) -> list[ListEntry]:
    if file == "-":
        return read_entries(sys.stdin.buffer, "stdin")
    try:
        with open(file, "rb") as opened:
            return read_entries(opened, file)
    except OSError as error:
        raise UsageError(f"--all {file} cannot be read: {error.strerror}") from error


def _warn_of_own_list(file: str, entries: Iterable[ListEntry]) -> None:
    """Warn if a listed repository holds the list, since its author could shorten it."""
    for entry in entries:
        if file != "-" and is_in_its_checkout(Path(file), entry.reference):
            text = (
                f"Warning: {file} lies in the checkout of {entry.reference}, which it lists: "
                "whoever changes that repository also chooses what is judged"
            )
            say(safe_line(text, _LONGEST), style=console.DOUBTFUL)
            return


def judge_entry(
    entry: ListEntry,
    judge: Callable[[str], Report],
    failures_of: Callable[[Report], Sequence[Finding]],
    *,
    debug: bool = False,
) -> Result:
    """Judges one reference; an error does not end the run of the list."""
    begun = time.monotonic()
    report, error = None, ""
    try:
        report = judge(entry.reference)
    except Exception as caught:
        if isinstance(caught, BrokenPipeError) and not isinstance(caught, EnvHubError):
            raise  # nobody reads our output any more; a repository's broken pipe differs
        error = printable(f"{caught}" or type(caught).__name__)
        if debug:
            say(console.safe_text(traceback.format_exc()))
    failures = [] if report is None else failures_of(report)
    seconds = time.monotonic() - begun
    return Result(entry=entry, report=report, failures=failures, error=error, seconds=seconds)


def exit_code(results: Sequence[Result]) -> Exit:
    """Returns the exit code for the worst verdict."""
    verdicts = {result.verdict for result in results}
    if Verdict.FAILED in verdicts:
        return Exit.ENVIRONMENT
    return Exit.OK if verdicts == {Verdict.PASSED} else Exit.UNJUDGED


def write_junit(path: Path, results: Sequence[Result]) -> None:
    """Write the file for ``--junit``. Raises ``UsageError``: it is unwritable; ``PolicyError``: a
    listed repository has put a link there.
    """
    root = ElementTree.Element("testsuites", name="envhub check")
    root.extend(map(_suite, results))
    for name in ("tests", "failures", "errors"):
        root.set(name, str(sum(int(suite.attrib[name]) for suite in root)))
    write_report(path, reports.xml(root), (result.entry.reference for result in results))


def _suite(result: Result) -> ElementTree.Element:
    """Returns a JUnit suite: the checks as test cases, or an error for a missing judgement."""
    if result.report is not None:
        suite = reports.suite(result.report, result.failures)
    else:
        name = reports.xml_text(printable(result.entry.reference, _LONGEST))
        suite = ElementTree.Element(
            "testsuite", name=name, tests="1", failures="0", errors="1", skipped="0"
        )
        case = ElementTree.SubElement(suite, "testcase", classname="repository", name="judged")
        error = ElementTree.SubElement(case, "error", message=result.verdict.value)
        error.text = reports.xml_text(printable(result.error, _LONGEST))
    suite.set("time", f"{result.seconds:.3f}")
    return suite


def show_results(results: Sequence[Result], *, json: bool, github: bool) -> None:
    """Print the results. Raises ``Exit`` with the exit code: not all references passed."""
    counts = Counter(result.verdict for result in results)
    words = ", ".join(
        f"{counts[verdict]} {verdict.value}" for verdict in Verdict if counts[verdict]
    )
    code = exit_code(results)
    if github:
        annotate(_workflow_commands(results), _summary(results, words))
    if json:
        rows = list(map(_document, results))
        by_name = {verdict.value: counts[verdict] for verdict in Verdict}
        console.print_json({"format": _FORMAT, "counts": by_name, "results": rows})
    elif not github:
        for result in results:
            if result.verdict is not Verdict.PASSED:
                show(result.verdict.value, result.entry.reference, _COLOURS[result.verdict])
                for line in result.why:
                    show("", line, "dim")
        styles = {Exit.OK: console.GOOD, Exit.UNJUDGED: console.DOUBTFUL}
        say(f"{words}.", styles.get(code, console.BAD))
    if code is not Exit.OK:
        raise typer.Exit(code)


def _document(result: Result) -> dict[str, Any]:
    report = result.report
    return {
        "reference": result.entry.reference,
        "line": result.entry.line,
        "verdict": result.verdict.value,
        "why": result.why,
        "seconds": round(result.seconds, 3),
        "report": None if report is None else reports.document(report, result.failures),
    }


def _workflow_commands(results: Iterable[Result]) -> Iterator[str]:
    """Yields a GitHub annotation for each reference that did not pass."""
    for result in results:
        if result.verdict is not Verdict.PASSED:
            words = "\n".join([result.verdict.value, *result.why])
            title = f"envhub check: {printable(result.entry.reference, _LONGEST)}"
            yield reports.workflow_command("error", title, words)


def _summary(results: Iterable[Result], words: str) -> str:
    """Returns a table for GitHub's step summary; escapes a stranger's text."""
    lines = [f"### envhub check: {words}", "", "| | reference | |", "| --- | --- | --- |"]
    for result in results:
        cells = (printable(result.entry.reference, _LONGEST), "; ".join(result.why))
        lines.append(f"| {result.verdict.value} | {' | '.join(map(reports.cell, cells))} |")
    return "\n".join(lines) + "\n"
