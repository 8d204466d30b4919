"""Lists the differences between two commits, in terms of a repository's behaviour.

Two findings are the same if they are in the same file, in lines with the same text: moved lines are
no change, and a finding in a changed line is new. A finding about a whole file, such as a pickle,
an archive or partly read source, is new if the file has changed.
"""

from __future__ import annotations

import codecs
import difflib
import itertools
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from envhub_sandbox.extras.judge.checks import Severity
from envhub_sandbox.extras.judge.findings import Finding
from envhub_sandbox.extras.judge.static import Static, bytes_of
from envhub_sandbox.extras.packages.locks.lockfile import TaskFingerprint
from envhub_sandbox.extras.packages.locks.making import drift_of_tasks
from envhub_sandbox.hub.listing import FileRecord, differing
from envhub_worker.protocol.text import printable, size_text

_MOST_BYTES = 1 << 20
_LONGEST = 500
_AROUND, _COMPARED, _MOST_LINES, _WIDEST = 2, 500, 60, 200
"""Lines around a change; lines compared from the first change on; lines and characters shown."""


@dataclass(frozen=True)
class Change:
    """One difference.

    Attributes:
        what: ``"file"``, ``"entry"``, ``"python"``, ``"package"``, ``"import"``, ``"finding"`` or
            ``"environment"``.
        how: ``"new"``, ``"gone"``, ``"changed"`` or ``"renamed"``.
        lines: The diff of a text file, in the form of ``diff -u``, escaped and bounded.
    """

    what: str
    how: str
    text: str
    finding: Finding | None = None
    lines: tuple[str, ...] = ()

    def weighs(self, least: Severity) -> bool:
        """Tells whether this is a new finding of at least this severity."""
        return (
            self.finding is not None
            and self.how == "new"
            and self.finding.check.severity.reaches(least)
        )


def changes(then: Static, now: Static) -> list[Change]:
    """Lists all differences, in the order of ``Change.what``."""
    # the files in both commits whose bytes differ
    before, after = _records(then), _records(now)
    other = set(differing(now.snapshot.root, after.values(), before.values())) & set(before)
    return [
        *_files(then, now, other),
        *_value("entry", _entry(then), _entry(now)),
        *_value("python", _python(then), _python(now)),
        *_named("package", _packages(then), _packages(now)),
        *_named("import", _imports(then), _imports(now)),
        *sorted(_findings(then, now, other), key=_rank),
    ]


def _rank(change: Change) -> int:
    return 0 if change.finding is None else change.finding.check.severity.rank


def _records(read: Static) -> dict[str, FileRecord]:
    return {file.record.path: file.record for file in read.files}


def _files(then: Static, now: Static, other: Collection[str]) -> Iterator[Change]:
    before, after = _records(then), _records(now)
    gone = {path: record.digest for path, record in before.items() if path not in after}
    was = {digest: path for path, digest in gone.items()}
    moved = {was.get(one.digest) for path, one in after.items() if path not in before}
    for path in sorted({*before, *after}):
        if path in other:
            sizes = f"{size_text(before[path].size)}, now {size_text(after[path].size)}"
            lines = _changed_lines(then.snapshot.root / path, now.snapshot.root / path)
            yield Change("file", "changed", _shown(f"{path}: {sizes}"), lines=lines)
        elif path in gone and path not in moved:
            yield Change("file", "gone", _shown(path))
        elif path not in before:
            yield _new(after[path], was)


def _changed_lines(then: Path, now: Path) -> tuple[str, ...]:
    """Returns the changed lines of a text file, as ``diff -u`` shows them; empty for binary files.

    Compares only a bounded number of lines, so that a stranger's file cannot take long.
    """
    try:
        before, after = map(_lines, (then, now))
    except UnicodeDecodeError:
        return ()
    pairs = zip(before, after, strict=False)
    same = next(
        (at for at, (old, new) in enumerate(pairs) if old != new), min(len(before), len(after))
    )
    start = max(0, same - _AROUND)
    old, new = (lines[start : start + _COMPARED] for lines in (before, after))
    diff = difflib.unified_diff(old, new, lineterm="", n=_AROUND)
    lines = [printable(line, _WIDEST) for line in itertools.islice(diff, 2, _MOST_LINES + 3)]
    longest = max(path.stat().st_size for path in (then, now))
    is_long = longest > _MOST_BYTES or max(len(before), len(after)) > start + _COMPARED
    if is_long or len(lines) > _MOST_LINES:
        lines[_MOST_LINES:] = ["... there may be more, from here on not compared"]
    return tuple(lines)


def _lines(path: Path) -> list[str]:
    """Splits a text at line feeds only. ``splitlines`` also splits at a form feed, which is a blank
    to Python: the rest of a comment would then look like a line of code.
    """
    text = codecs.getincrementaldecoder("utf-8")().decode(bytes_of(path, _MOST_BYTES))
    return text.removesuffix("\n").split("\n") if text else []


def _new(record: FileRecord, was: Mapping[str, str]) -> Change:
    if record.digest in was:
        return Change("file", "renamed", _shown(f"{record.path}: was {was[record.digest]}"))
    return Change("file", "new", _shown(f"{record.path}: {size_text(record.size)}"))


def _shown(text: str) -> str:
    return printable(text, _LONGEST)


def _entry(read: Static) -> str:
    arguments = " or ".join(f"make_env({text})" for text, _ in read.entries)
    return f"{read.snapshot.path}: {arguments or 'no make_env at its top'}"


def _python(read: Static) -> str:
    return (read.declared.python if read.declared else "") or "any"


def _value(what: str, then: str, now: str) -> Iterator[Change]:
    if then != now:
        yield Change(what, "changed", _shown(f"{then}, now {now}"))


def _packages(read: Static) -> dict[str, str]:
    by_package: dict[str, list[str]] = {}
    for package in read.declared.wanted if read.declared else ():
        by_package.setdefault(package.requirement.name.lower(), []).append(str(package))
    return {name: ", ".join(sorted(texts)) for name, texts in by_package.items()}


def _imports(read: Static) -> dict[str, str]:
    return {name: name for name in read.modules}


def _named(what: str, then: Mapping[str, str], now: Mapping[str, str]) -> Iterator[Change]:
    for name in sorted({*then, *now}):
        if name not in then:
            yield Change(what, "new", _shown(now[name]))
        elif name not in now:
            yield Change(what, "gone", _shown(then[name]))
        else:
            yield from _value(what, then[name], now[name])


def _findings(then: Static, now: Static, other: Collection[str]) -> Iterator[Change]:
    before, after = _by_line(then, other), _by_line(now, other)
    for how, mine, others in (("new", after, before), ("gone", before, after)):
        counts = Counter({key: len(found) for key, found in others.items()})
        for key, found in mine.items():
            for finding in found[counts[key] :]:
                yield Change("finding", how, finding.text, finding)


def _by_line(read: Static, other: Collection[str]) -> dict[tuple[str, ...], list[Finding]]:
    """Groups findings by their message and by the text of their line, whatever its number. For a
    finding without a line, or in a file that is not in the list, the hash of the file replaces the
    line if the file is in ``other``. Findings hold file names in printable form.
    """
    lines: dict[str, list[str]] = {}
    findings: dict[tuple[str, ...], list[Finding]] = {}
    records = _records(read)
    digests: dict[str, list[str]] = {}
    for path in other:
        digests.setdefault(printable(path, _LONGEST), []).append(records[path].digest)
    for finding in read.findings:
        text = sorted(digests.get(finding.file, ()))
        if finding.line and finding.file in records:
            if finding.file not in lines:
                data = bytes_of(read.snapshot.root / finding.file, _MOST_BYTES)
                split = re.split("\r\n|\r|\n", data.decode("utf-8", "replace"))
                lines[finding.file] = [line.strip() for line in split]
            text = lines[finding.file][finding.line - 1 : finding.line]
        findings.setdefault((finding.id, finding.file, finding.message, *text), []).append(finding)
    return findings


def environments(then: Sequence[TaskFingerprint], now: Sequence[TaskFingerprint]) -> list[Change]:
    """Compares the environments of two commits. Trust: input from the worker, already checked."""
    lines = (line.removeprefix("environment ") for line in drift_of_tasks(then, now))
    return [Change("environment", "changed", _shown(line)) for line in lines]


def document(then: Static, now: Static, found: list[Change]) -> dict[str, Any]:
    """Returns all differences as plain data."""
    return {
        "then": then.reference,
        "now": now.reference,
        "same": not found,
        "changes": [
            {
                "what": change.what,
                "change": change.how,
                "text": change.text,
                "finding": change.finding and change.finding.document(),
                "lines": list(change.lines),
            }
            for change in found
        ],
    }
