"""``envhub check --all FILE``: a list of repositories, judged one after the other.

References are the caller's words; findings, and why a repository could not be judged, are partly a
stranger's text, which each form escapes. No result of an earlier run is read: a file that says what
has passed could be the work of who is judged.
"""

from __future__ import annotations

import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import typer

from envhub_sandbox.cli.shared.console import (
    BAD,
    DOUBTFUL,
    GOOD,
    print_json,
    safe_line,
    safe_text,
    say,
    show,
)
from envhub_sandbox.cli.shared.exits import Exit, UsageError
from envhub_sandbox.extras.judge import reports
from envhub_sandbox.extras.judge.checks import Severity
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
    """What came of a reference, the worst first."""

    FAILED = "failed"
    UNJUDGED = "not judged"
    PASSED = "passed"


_COLOURS = {Verdict.PASSED: "green", Verdict.FAILED: "red", Verdict.UNJUDGED: "yellow"}


@dataclass(frozen=True, kw_only=True)
class Result:
    """What came of one reference.

    Attributes:
        report: None if there is none; also a deadline leaves one.
        failures: The findings that fail it.
        error: Why it could not be judged. Trust: partly a stranger's text.
    """

    entry: ListEntry
    report: Report | None = None
    failures: Sequence[Finding] = ()
    error: str = ""
    seconds: float = 0.0

    @property
    def verdict(self) -> Verdict:
        """Passed is only what was judged to its end."""
        if self.report is None or self.report.is_unjudged(self.failures):
            return Verdict.UNJUDGED
        return Verdict.FAILED if self.failures else Verdict.PASSED

    @property
    def why(self) -> list[str]:
        """Why it has not passed, a line for each check that fails it."""
        first = {one.id: f"{one.id}: {one.text}" for one in reversed(self.failures)}
        checks = dict.fromkeys(one.id for one in self.failures)
        lines = [first[check] for check in checks] or [self.error]
        return [printable(line, _LONGEST) for line in lines if line]

    def document(self) -> dict[str, Any]:
        """Everything, as plain data."""
        report = self.report
        return {
            "reference": self.entry.reference,
            "line": self.entry.line,
            "verdict": self.verdict.value,
            "why": self.why,
            "seconds": round(self.seconds, 3),
            "report": None if report is None else reports.document(report, self.failures),
        }

    def suite(self) -> ElementTree.Element:
        """One of JUnit's suites: the checks as test cases, or an error that says why not."""
        if self.report is not None:
            suite = reports.suite(self.report, self.failures)
        else:
            name = reports.xml_text(printable(self.entry.reference, _LONGEST))
            suite = ElementTree.Element(
                "testsuite", name=name, tests="1", failures="0", errors="1", skipped="0"
            )
            case = ElementTree.SubElement(suite, "testcase", classname="repository", name="judged")
            error = ElementTree.SubElement(case, "error", message=self.verdict.value)
            error.text = reports.xml_text(printable(self.error, _LONGEST))
        suite.set("time", f"{self.seconds:.3f}")
        return suite


@dataclass(kw_only=True)
class ListRun:
    """One ``envhub check --all``.

    Attributes:
        file: The list; ``-`` is stdin.
        judge: Judges a reference.
        least, allowed: Which findings fail it, as in ``Report.failures``.
        settings, policy: The caller's files.
        debug: Whether tracebacks are shown.
        results: What has come of each reference so far.
    """

    file: str
    judge: Callable[[str], Report]
    least: Severity
    allowed: Collection[str]
    settings: Path | None
    policy: Path | None
    debug: bool = False
    results: list[Result] = field(default_factory=list)

    def run(self) -> None:
        """Judge each repository of the list.
        Raises ``UsageError``: the list cannot be read; ``HubReferenceError``: a line of it;
        ``PolicyError``: a file of the caller's lies in a repository of the list.
        """
        entries = self._entries()
        places = {"--settings": self.settings, "--policy": self.policy}
        for entry in entries:
            where = f" (line {entry.line} of {self.file})"
            refuse_files_of_the_judged(places, entry.reference, where)
        self._warn_of_own_list(entries)
        for number, entry in enumerate(entries, 1):
            result = self.judged(entry)
            self.results.append(result)
            words = f"[{number}/{len(entries)}] {result.verdict.value:<10} {entry.reference}"
            line = "; ".join([words, duration_text(result.seconds), *result.why])
            say(safe_line(line, 300), style=_COLOURS[result.verdict])

    def _entries(self) -> list[ListEntry]:
        if self.file == "-":
            return read_entries(sys.stdin.buffer, "stdin")
        try:
            with open(self.file, "rb") as opened:
                return read_entries(opened, self.file)
        except OSError as error:
            raise UsageError(f"--all {self.file} cannot be read: {error.strerror}") from error

    def _warn_of_own_list(self, entries: Iterable[ListEntry]) -> None:
        """Warn if a listed repository holds the list, since its author could shorten it."""
        for entry in entries:
            if self.file != "-" and is_in_its_checkout(Path(self.file), entry.reference):
                text = (
                    f"Warning: {self.file} lies in the checkout of {entry.reference}, which it "
                    "lists: whoever changes that repository also chooses what is judged"
                )
                say(safe_line(text, _LONGEST), style=DOUBTFUL)
                return

    def judged(self, entry: ListEntry) -> Result:
        """What comes of one reference; whatever it raises ends no other."""
        begun = time.monotonic()
        report, error = None, ""
        try:
            report = self.judge(entry.reference)
        except Exception as caught:
            if isinstance(caught, BrokenPipeError) and not isinstance(caught, EnvHubError):
                raise  # what is printed has no reader any more; a repository's own pipe is not that
            error = printable(f"{caught}" or type(caught).__name__)
            if self.debug:
                say(safe_text(traceback.format_exc()))
        return Result(
            entry=entry,
            report=report,
            failures=[] if report is None else report.failures(self.least, self.allowed),
            error=error,
            seconds=time.monotonic() - begun,
        )

    def write(self, junit: Path | None) -> None:
        """Write the file of ``--junit``. Raises ``UsageError``: it cannot be written;
        ``PolicyError``: a repository of the list has put a link there.
        """
        if junit is None:
            return
        root = ElementTree.Element("testsuites", name="envhub check")
        root.extend(result.suite() for result in self._worst_first())
        for name in ("tests", "failures", "errors"):
            root.set(name, str(sum(int(suite.attrib[name]) for suite in root)))
        references = (result.entry.reference for result in self.results)
        write_report(junit, reports.xml(root), references)

    def show(self, *, json: bool, github: bool) -> None:
        """Print what has come of it, and end with its code. Raises ``Exit``: not all passed."""
        if github:
            annotate(self._workflow_commands(), self._summary())
        if json:
            counts = self._counts()
            found = {verdict.value: counts[verdict] for verdict in Verdict}
            rows = [result.document() for result in self._worst_first()]
            print_json({"format": _FORMAT, "counts": found, "results": rows})
        elif not github:
            self._print()
        if self.exit is not Exit.OK:
            raise typer.Exit(self.exit)

    def _print(self) -> None:
        """What did not pass, and how many did."""
        for result in self._worst_first():
            if result.verdict is not Verdict.PASSED:
                show(result.verdict.value, result.entry.reference, _COLOURS[result.verdict])
                for line in result.why:
                    show("", line, "dim")
        style = {Exit.OK: GOOD, Exit.UNJUDGED: DOUBTFUL}.get(self.exit, BAD)
        say(f"{self._in_words()}.", style)

    @property
    def exit(self) -> Exit:
        """The worst verdict's."""
        verdicts = {result.verdict for result in self.results}
        if Verdict.FAILED in verdicts:
            return Exit.ENVIRONMENT
        return Exit.OK if verdicts == {Verdict.PASSED} else Exit.UNJUDGED

    def _worst_first(self) -> list[Result]:
        order = list(Verdict)
        return sorted(self.results, key=lambda result: order.index(result.verdict))

    def _counts(self) -> Counter[Verdict]:
        return Counter(result.verdict for result in self.results)

    def _in_words(self) -> str:
        counts = self._counts()
        return ", ".join(f"{counts[one]} {one.value}" for one in Verdict if counts[one])

    def _workflow_commands(self) -> Iterator[str]:
        """One of GitHub's annotations for each reference that did not pass."""
        for result in self._worst_first():
            if result.verdict is not Verdict.PASSED:
                words = "\n".join([result.verdict.value, *result.why])
                title = f"envhub check: {printable(result.entry.reference, _LONGEST)}"
                yield reports.workflow_command("error", title, words)

    def _summary(self) -> str:
        """A table for GitHub's step summary; a stranger's text is no markup there."""
        heads = ["| | reference | |", "| --- | --- | --- |"]
        lines = [f"### envhub check: {self._in_words()}", "", *heads]
        for result in self._worst_first():
            cells = (printable(result.entry.reference, _LONGEST), "; ".join(result.why))
            lines.append(f"| {result.verdict.value} | {' | '.join(map(reports.cell, cells))} |")
        return "\n".join(lines) + "\n"
