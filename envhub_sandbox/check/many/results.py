"""What has been judged, in a folder: whatever ends a run, the next one goes on from there.

A repository's report (``NAME.json``) is written last, and says which page (``NAME.html``) belongs
to it: one that is there is whole. It counts again for the same commit, judged in the same way.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any

from envhub_sandbox.check import reports
from envhub_sandbox.check.findings import Finding, Report
from envhub_sandbox.check.many.entries import ListEntry
from envhub_sandbox.hub.sources.parsing import content
from envhub_sandbox.system.folders import write_whole_file
from envhub_sandbox.system.locks import held
from envhub_worker.protocol.text import printable

MOST_BYTES = 32 << 20
"""Of one report, and of one page."""
_LONGEST = 500
_MARK = ".envhub-check"
_RUNNING = ".running"
_REPORTS = "reports"


class FolderError(Exception):
    """Results cannot be kept there."""


class ForeignResultError(Exception):
    """A file is where a result would be, and is none; the text says why."""


class Verdict(Enum):
    """What came of a reference."""

    FAILED = "failed"
    UNJUDGED = "not judged"
    WAITING = "waiting"
    PASSED = "passed"


@dataclass(frozen=True, kw_only=True)
class Result:
    """What came of one reference.

    Attributes:
        commit: Which was judged; empty if none was.
        found: How many findings of each severity.
        fails: What fails it: a check, and what was found. Trust: the latter is a stranger's text.
        ended: When, as ISO 8601 has it.
        said: Why it was not judged, or not to its end. Trust: partly a stranger's text.
    """

    listed: ListEntry
    verdict: Verdict = Verdict.WAITING
    commit: str = ""
    found: Mapping[str, int] | None = None
    fails: tuple[tuple[str, str], ...] = ()
    seconds: float = 0.0
    ended: str = ""
    said: str = ""

    @property
    def why(self) -> list[str]:
        """Why it has not passed, a line for each check that fails it."""
        first = dict(reversed(self.fails))
        checks = dict.fromkeys(check for check, _ in self.fails)
        lines = [f"{check}: {first[check]}" for check in checks]
        return [printable(line, _LONGEST) for line in lines or [self.said] if line]

    @property
    def is_judged(self) -> bool:
        """Whether it need not be judged again."""
        return self.verdict in (Verdict.PASSED, Verdict.FAILED)

    @property
    def has_report(self) -> bool:
        """Whether there is a report: also of one that a deadline has ended."""
        return self.found is not None


class Results:
    """A folder of results, which one run at a time has.
    ``settings``: a digest of how is judged: results of others do not count.
    """

    def __init__(self, folder: Path, settings: str) -> None:
        self._folder, self._settings = folder, settings

    @contextlib.contextmanager
    def held(self) -> Iterator[Path]:
        """Hold the folder; yields a place in it for what is being judged.
        Raises ``FolderError``: it has other things in it, is another run's, or cannot be written.
        """
        running = self._folder / _RUNNING
        try:
            with self._locked():
                (self._folder / _REPORTS).mkdir(exist_ok=True)
                _remove(running)  # of a run that was killed
                running.mkdir(mode=0o700)
                try:
                    yield running
                finally:
                    _remove(running)
        except BrokenPipeError:
            raise  # what is printed meanwhile has no reader any more
        except OSError as error:
            raise FolderError(f"{self._folder}: results cannot be kept there: {error}") from error

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        self._folder.mkdir(parents=True, exist_ok=True)
        mark = self._folder / _MARK
        if not mark.exists() and any(self._folder.iterdir()):
            raise FolderError(f"{self._folder} has other files and no results: name a new folder")
        with contextlib.ExitStack() as lock:
            try:
                lock.enter_context(held(mark, mode=0o666))
            except TimeoutError:
                why = f"another run is writing to {self._folder}; wait until it has ended"
                raise FolderError(why) from None
            yield

    def kept(self, listed: ListEntry) -> Result | None:
        """What came of a reference when it was judged before, in this way; None if it was not.
        Raises ``ForeignResultError``: what is there is cut off, changed, or none of ours.
        """
        found = self._read(listed)
        return None if found is None else found[0]

    def report(self, listed: ListEntry) -> tuple[Report, list[Finding]] | None:
        """The report that ``kept`` speaks of, if there is one."""
        with contextlib.suppress(ForeignResultError):
            if (found := self._read(listed)) is not None:
                return found[1:]
        return None

    def _read(self, listed: ListEntry) -> tuple[Result, Report, list[Finding]] | None:
        path = self._path(listed, "json")
        if not os.path.lexists(path):
            return None
        data = content(path, MOST_BYTES)
        if data is None:
            raise ForeignResultError(f"{path} was not written by envhub")
        try:
            document = json.loads(data)
            how = document["judgement"]
            if how["settings"] != self._settings:
                return None
            if how["reference"] != listed.meaning or how["page"] != self._digest(listed):
                raise ValueError("it is for another reference, or has no page")
            report, failures = reports.read_report(document)
            seconds, ended = _seconds(how["seconds"]), str(how["ended"])[:40]
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise ForeignResultError(f"{path} is cut off, or was changed ({error})") from error
        result = _result(listed, report, failures, seconds=seconds, ended=ended)
        return result, report, failures

    def keep(
        self,
        listed: ListEntry,
        document: Mapping[str, Any],
        page: Path,
        *,
        seconds: float,
        ended: str,
    ) -> Result:
        """Keep a report as ``check --json`` has printed it, and take its page.
        Raises ``ForeignResultError``: it is no such report, or there is no page; ``OSError``: it
        cannot be written.
        """
        try:
            report, failures = reports.read_report(document)
        except (KeyError, TypeError, ValueError) as error:
            raise ForeignResultError(f"this is not a report: {error}") from error
        data = content(page, MOST_BYTES)
        if data is None:
            raise ForeignResultError("there is no page")
        _write(self._path(listed, "html"), data)
        how = {
            "settings": self._settings,
            "reference": listed.meaning,
            "page": hashlib.sha256(data).hexdigest(),
            "seconds": round(seconds, 3),
            "ended": ended,
        }
        text = json.dumps({**document, "judgement": how}, indent=2, allow_nan=False)
        _write(self._path(listed, "json"), text.encode())
        return _result(listed, report, failures, seconds=seconds, ended=ended)

    def forget(self, listed: ListEntry) -> None:
        """Let it be judged again."""
        self._path(listed, "json").unlink(missing_ok=True)

    def write(self, name: str, text: str) -> None:
        """Write a file about all of them."""
        _write(self._folder / name, text.encode("utf-8", "backslashreplace"))

    def _digest(self, listed: ListEntry) -> str | None:
        data = content(self._path(listed, "html"), MOST_BYTES)
        return None if data is None else hashlib.sha256(data).hexdigest()

    def _path(self, listed: ListEntry, kind: str) -> Path:
        return self._folder / link(listed, kind)


def link(listed: ListEntry, kind: str) -> str:
    """Where a reference's ``html`` or ``json`` lies in the folder."""
    return f"{_REPORTS}/{listed.name}.{kind}"


_write = partial(write_whole_file, mode=0o666, durable=True)


def _result(
    listed: ListEntry, report: Report, failures: list[Finding], *, seconds: float, ended: str
) -> Result:
    unjudged = report.is_unjudged(failures)
    return Result(
        listed=listed,
        verdict=Verdict.UNJUDGED if unjudged else Verdict.FAILED if failures else Verdict.PASSED,
        commit=report.commit,
        found=Counter(one.check.severity.value for one in report.findings),
        fails=() if unjudged else tuple((one.id, one.text) for one in failures),
        seconds=seconds,
        ended=ended,
        said=failures[0].message if unjudged else "",
    )


def _seconds(value: object) -> float:
    seconds = float(value)  # type: ignore[arg-type]
    if not math.isfinite(seconds):
        raise ValueError("that is no time")
    return seconds


def _remove(folder: Path) -> None:
    if folder.exists():
        shutil.rmtree(folder)
