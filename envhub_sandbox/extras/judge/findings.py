"""``Finding`` and ``Report``: what checks found, how severe it is, and the verdict."""

from __future__ import annotations

import re
from bisect import insort
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any

from envhub_sandbox.errors import EnvHubError, RemoteEnvError, WorkerDiedError, WorkerTimeoutError
from envhub_sandbox.extras.judge.checks import CHECKS, CURES, Check, Severity
from envhub_sandbox.play.confinement import Confinement
from envhub_sandbox.play.plays import Play
from envhub_worker.protocol.text import counted, duration_text, first_of, printable

_RETURNED = re.compile(
    r"(?:reset|step) of sub-environment \d+ returned |\S{1,200} \([^()]{1,200}\) does not return "
)
_LONGEST = 1_000
_MOST = 500
"""Findings: a repository of ten thousand files is no reason for as many lines."""
_SHOWN = 60
_OF_EACH = 20
"""Of one check, which are kept whatever there is of others: no flood of notes hides an error."""


def _cause(error: EnvHubError) -> str:
    """What an error is about, as ``CURES`` names it. Trust: the worker's word."""
    if isinstance(error, WorkerDiedError):
        return error.reason
    if isinstance(error, WorkerTimeoutError):
        return "timeout"
    remote = error if isinstance(error, RemoteEnvError) else error.__cause__
    if not isinstance(remote, RemoteEnvError):
        return ""
    return "returned" if _RETURNED.match(remote.message) else remote.type_name.rpartition(".")[2]


@dataclass(frozen=True)
class Finding:
    """One check that does not hold.

    Attributes:
        message: What was seen, printable and of bounded length.
        task: ``"suite / task"``; empty where it is about the whole repository.
        file, line: Where it stands in the repository; empty and 0 where it stands nowhere.
        cause: The class of the error that it is about, or how a process ended; may be empty. Trust:
            the worker's word.
    """

    id: str
    message: str
    task: str = ""
    file: str = ""
    line: int = 0
    cause: str = ""

    @property
    def text(self) -> str:
        """What was seen, behind where it stands in the repository."""
        place = f"{self.file}:{self.line}: " if self.line else f"{self.file}: " if self.file else ""
        return f"{place}{self.message}"

    def document(self) -> dict[str, Any]:
        """As plain data, but for its task."""
        return {
            "check": self.id,
            "severity": self.check.severity.value,
            "message": self.message,
            "file": self.file or None,
            "line": self.line or None,
        }

    @property
    def check(self) -> Check:
        """What did not hold."""
        return CHECKS[self.id]

    @property
    def cure(self) -> str:
        """What an author changes: by the error, where that says more than the check."""
        return CURES.get(self.cause, self.check.cure)


@dataclass
class Report:
    """A judgement.

    Attributes:
        reference: What was judged, pinned.
        findings: The most severe first; those of one severity as they were found.
        passed: Checks that were made, by id and task, and found nothing.
        figures: Of each task that was played: plain numbers.
        provenance: What ran, if anything did.
        left_out: How many findings are not in ``findings``.
        asked: How it was judged, by name, in words of ours.
        plays: What each task gave to look at.
        commit: Of what was judged; of a folder of this machine a hash of its content.
        confinement: What confined it; None where nothing of it ran.
        waiting: Tasks that have not been judged to their end.
        unmade: Checks that were not made of anything, where a deadline ended it.
        folder: Where it lies below the current folder, which in CI is the checkout whose files are
            annotated; ends with a slash, empty where it is that folder or lies elsewhere.
    """

    reference: str
    findings: list[Finding] = field(default_factory=list)
    passed: list[tuple[str, str]] = field(default_factory=list)
    figures: dict[str, dict[str, float]] = field(default_factory=dict)
    provenance: dict[str, Any] | None = None
    left_out: int = 0
    asked: dict[str, str] = field(default_factory=dict)
    plays: dict[str, Play] = field(default_factory=dict)
    commit: str = ""
    confinement: Confinement | None = None
    waiting: list[str] = field(default_factory=list)
    unmade: list[str] = field(default_factory=list)
    folder: str = ""
    _kept: Counter[str] = field(default_factory=Counter, repr=False)

    def judged(self, check: str, texts: Iterable[str], task: str = "") -> None:
        """A check was made: it found this, or nothing. Trust: texts from the worker."""
        messages = list(texts)
        for message in messages:
            self.add(Finding(check, message, task))
        if not messages:
            self.passed.append((check, task))

    def raised(self, check: str, error: EnvHubError, task: str = "", message: str = "") -> None:
        """A check ended in an error: what it says, and the author's line. Trust: the worker's."""
        remote = error if isinstance(error, RemoteEnvError) else error.__cause__
        place = (remote.file, remote.line) if isinstance(remote, RemoteEnvError) else ("", 0)
        if isinstance(error, RemoteEnvError):
            message = f"{error.type_name}: {error.message}"
        self.add(Finding(check, message or str(error), task, *place, cause=_cause(error)))

    def add(self, finding: Finding) -> Finding | None:
        """Add what was found, made printable; None where there is no room for it."""
        if len(self.findings) >= _MOST and self._kept[finding.id] >= _OF_EACH:
            self.left_out += 1
            return None
        self._kept[finding.id] += 1
        kept = replace(
            finding,
            message=printable(finding.message, _LONGEST),
            task=printable(finding.task, 200),
            file=printable(finding.file, 500),
        )
        insort(self.findings, kept, key=attrgetter("check.severity.rank"))
        return kept

    def failures(self, fail_on: Severity, allowed: Collection[str] = ()) -> list[Finding]:
        """The findings that weigh enough, without those that are allowed."""
        findings = (finding for finding in self.findings if finding.id not in allowed)
        return [finding for finding in findings if finding.check.severity.reaches(fail_on)]

    def stopped(self, seconds: float, at: str) -> None:
        """A deadline of so many seconds ended it at something: what was not judged is a finding."""
        made = {finding.id for finding in self.findings} | {check for check, _ in self.passed}
        self.unmade = [check for check in CHECKS if check not in made and check != "deadline"]
        left = [*self.unmade, *(f"all of {task}" for task in self.waiting)]
        shown = ", ".join(first_of(left, _SHOWN))
        text = f"ended after {duration_text(seconds)}, at: {at}. Not judged: {shown or 'its end'}"
        self.judged("deadline", [text])

    @staticmethod
    def is_unjudged(failures: Collection[Finding]) -> bool:
        """Whether nothing fails but that there was no time to judge all of it."""
        return bool(failures) and all(finding.id == "deadline" for finding in failures)

    def verdict(self, failures: Collection[Finding]) -> str:
        """What came of it, in a sentence."""
        held = counted(len({check for check, _ in self.passed}), "check holds", "checks hold")
        findings = counted(len(self.findings) + self.left_out, "finding")
        if not failures:
            return f"{held}, {findings}: passed"
        if self.is_unjudged(failures):
            return f"{held}, {findings}; not judged to its end"
        return f"{held}, {findings}, of which {counted(len(failures), 'fails', 'fail')} it"
