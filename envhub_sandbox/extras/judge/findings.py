"""``Finding`` and ``Report``: the findings of checks, their severity, and the verdict."""

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
from envhub_sandbox.extras.judge.play.film import Play
from envhub_sandbox.play.confinement import Confinement
from envhub_worker.protocol.text import counted, duration_text, first_of, printable

_RETURNED = re.compile(
    r"(?:reset|step) of sub-environment \d+ returned |\S{1,200} \([^()]{1,200}\) does not return "
)
_LONGEST = 1_000
_MOST = 500
"""Findings to keep: ten thousand files must not produce as many lines."""
_SHOWN = 60
_OF_EACH = 20
"""Findings that each check may always keep: no flood of notes hides an error."""


def _cause(error: EnvHubError) -> str:
    """Returns the key of an error in ``CURES``. Trust: the worker's word."""
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
    """A failed check.

    Attributes:
        message: The observation, printable and bounded.
        task: ``"suite / task"``; empty if the finding is about the whole repository.
        file, line: The position in the repository; empty and 0 if there is none.
        cause: The class of an error, or how a process ended; may be empty. Trust: the worker's
            word.
    """

    id: str
    message: str
    task: str = ""
    file: str = ""
    line: int = 0
    cause: str = ""

    @property
    def text(self) -> str:
        """Returns the message after its position in the repository."""
        place = f"{self.file}:{self.line}: " if self.line else f"{self.file}: " if self.file else ""
        return f"{place}{self.message}"

    def document(self) -> dict[str, Any]:
        """Returns the finding as plain data, without its task."""
        return {
            "check": self.id,
            "severity": self.check.severity.value,
            "message": self.message,
            "file": self.file or None,
            "line": self.line or None,
        }

    @property
    def check(self) -> Check:
        """Returns the failed check."""
        return CHECKS[self.id]

    @property
    def cure(self) -> str:
        """Returns the change that an author makes, by the error if listed, else by the check."""
        return CURES.get(self.cause, self.check.cure)


@dataclass
class Report:
    """The result of a judgement.

    Attributes:
        reference: The judged reference, pinned.
        findings: Most severe first; in the order of discovery within a severity.
        passed: The id and the task of each check without findings.
        figures: Plain numbers for each task that was played.
        provenance: A description of the code that ran, if any did.
        left_out: The number of findings that are not in ``findings``.
        asked: The settings of the judgement, by name, in our words.
        plays: The data of each task's play that the page shows.
        commit: The judged commit; for a local folder a hash of its content.
        confinement: The sandbox's confinement; None if no code ran.
        waiting: Tasks whose judgement is incomplete.
        unmade: Checks that no task had when a deadline ended the judgement.
        folder: The folder's path below the current folder, which in CI is the checkout with the
            annotated files; ends with a slash; empty if equal or elsewhere.
        most: How many findings to keep; each check may always keep some.
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
    most: int = _MOST
    _kept: Counter[str] = field(default_factory=Counter, repr=False)

    def judged(self, check: str, texts: Iterable[str], task: str = "") -> None:
        """Record a check and its findings, if any. Trust: texts from the worker."""
        messages = list(texts)
        for message in messages:
            self.add(Finding(check, message, task))
        if not messages:
            self.passed.append((check, task))

    def raised(self, check: str, error: EnvHubError, task: str = "", message: str = "") -> None:
        """Record a check that raised: text and author's line. Trust: text from the worker."""
        remote = error if isinstance(error, RemoteEnvError) else error.__cause__
        place = (remote.file, remote.line) if isinstance(remote, RemoteEnvError) else ("", 0)
        if isinstance(error, RemoteEnvError):
            message = f"{error.type_name}: {error.message}"
        self.add(Finding(check, message or str(error), task, *place, cause=_cause(error)))

    def add(self, finding: Finding) -> Finding | None:
        """Adds a finding in printable form; returns None if the report is full."""
        if len(self.findings) >= self.most and self._kept[finding.id] >= _OF_EACH:
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
        """Returns findings of at least this severity whose checks are not allowed."""
        findings = (finding for finding in self.findings if finding.id not in allowed)
        return [finding for finding in findings if finding.check.severity.reaches(fail_on)]

    def stopped(self, seconds: float, at: str) -> None:
        """Record that a deadline ended the judgement: the missing checks are a finding."""
        made = {finding.id for finding in self.findings} | {check for check, _ in self.passed}
        self.unmade = [check for check in CHECKS if check not in made and check != "deadline"]
        left = [*self.unmade, *(f"all of {task}" for task in self.waiting)]
        shown = ", ".join(first_of(left, _SHOWN))
        text = f"ended after {duration_text(seconds)}, at: {at}. Not judged: {shown or 'its end'}"
        self.judged("deadline", [text])

    @staticmethod
    def is_unjudged(failures: Collection[Finding]) -> bool:
        """Tells whether the only failure is the lack of time for the whole judgement."""
        return bool(failures) and all(finding.id == "deadline" for finding in failures)

    def verdict(self, failures: Collection[Finding]) -> str:
        """Returns the verdict in a sentence."""
        held = counted(len({check for check, _ in self.passed}), "check holds", "checks hold")
        findings = counted(len(self.findings) + self.left_out, "finding")
        if not failures:
            return f"{held}, {findings}: passed"
        if self.is_unjudged(failures):
            return f"{held}, {findings}; not judged to its end"
        return f"{held}, {findings}, of which {counted(len(failures), 'fails', 'fail')} it"
