"""What a repository holds and would do, read file by file without running any of it.

What is found is a hint for a person and no wall: who wants to hide a call can. The walls are the
sandbox's. What could not be read is found, too.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from envhub_sandbox.check import contents
from envhub_sandbox.check.constructs import constructs, long_lines
from envhub_sandbox.check.findings import Finding
from envhub_sandbox.check.parsing import MOST_BYTES, Parsed
from envhub_sandbox.errors import SnapshotError
from envhub_sandbox.hub import local
from envhub_sandbox.hub.listing import FileRecord, Snapshot

_MOST_BYTES_OF_TEXT = 1 << 20
_MOST_BYTES_IN_ALL = 32 << 20
_MOST_OF_A_FILE = 100
_MOST = 20_000
"""Findings: as many as there may be files."""
_LONGEST_LINK = 1024


@dataclass(frozen=True)
class File:
    """One file.

    Attributes:
        record: Its path, size and hash.
        kind: As in ``"Python"``, ``"text"``, ``"binary"``, ``"machine code"``.
    """

    record: FileRecord
    kind: str


@dataclass
class Survey:
    """What was read.

    Attributes:
        files: Every file, sorted by path.
        findings: What is worth a look, file by file.
    """

    files: list[File] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    def add(self, found: Iterable[Finding]) -> None:
        """Take what was found in one place, as far as there is room."""
        self.findings += itertools.islice(found, max(_MOST - len(self.findings), 0))


def survey(snapshot: Snapshot, parsed: Mapping[str, Parsed | None]) -> Survey:
    """Look at every file of a repository.

    Args:
        snapshot: The repository.
        parsed: What ``parsing.read`` read of it.
    """
    found = Survey()
    found.add(_papers(snapshot))
    found.add(_links(snapshot))
    left = _MOST_BYTES_IN_ALL
    for record in sorted(snapshot.files, key=lambda one: one.path):
        path = snapshot.root / record.path
        kind = contents.kind_of(record.path, _bytes(path, contents.BEGINNING))
        found.files.append(File(record, kind))
        found.add(contents.of_kind(record.path, kind))
        found.add(_in_name(record))
        if kind == "Python" and record.path in parsed:
            found.add(_in_code(record, parsed[record.path]))
        if kind in ("Python", "text") and record.size <= min(left, _MOST_BYTES_OF_TEXT):
            left -= record.size
            found.add(_in_text(record, path, is_code=kind == "Python"))
    if len(found.findings) >= _MOST:
        found.findings.append(Finding("source-unread", "there is more to find than is kept"))
    return found


def _bytes(path: Path, most: int) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(most)
    except OSError:
        return b""


def _in_name(record: FileRecord) -> Iterator[Finding]:
    for one in contents.hidden(record.path, record.path, is_code=True):
        yield Finding(one.id, f"its name {one.message}", file=record.path)


def _in_text(record: FileRecord, path: Path, *, is_code: bool) -> Iterator[Finding]:
    text = _bytes(path, record.size).decode("utf-8-sig", "replace")
    yield from contents.hidden(record.path, text, is_code=is_code)
    if is_code:
        yield from long_lines(record.path, text)


def _in_code(record: FileRecord, parsed: Parsed | None) -> Iterator[Finding]:
    if parsed is None:
        larger = f"it is larger than {MOST_BYTES >> 10} KiB, and has not been read"
        other = "it is no UTF-8 or no Python of this version, or more than is read of a repository"
        yield _unread(record, larger if record.size > MOST_BYTES else other)
        return
    found = constructs(record.path, parsed)
    yield from itertools.islice(found, _MOST_OF_A_FILE)
    if next(found, None) is not None:
        yield _unread(record, f"there is more in it than the first {_MOST_OF_A_FILE} findings")


def _unread(record: FileRecord, why: str) -> Finding:
    return Finding("source-unread", why, file=record.path)


def _links(snapshot: Snapshot) -> Iterator[Finding]:
    """Files under another's name; git's links arrive from the Hub as texts that name their target.

    Those of a folder are followed when it is copied, and lead nowhere else.
    """
    if snapshot.repo_type == "local":
        yield from _links_of_folder(snapshot)
        return
    there = {record.path for record in snapshot.files}
    there |= {str(parent) for path in there for parent in PurePosixPath(path).parents}
    for record in snapshot.files:
        target = _target(snapshot, record, there)
        if target is not None:
            message = f"reads like a link of git's, to {target}"
            yield Finding("source-link", message, file=record.path)


def _links_of_folder(snapshot: Snapshot) -> Iterator[Finding]:
    root = Path(snapshot.repo_id).resolve()
    try:
        for file in local.scan(root):
            if file.source != root / file.path:
                target = file.source.relative_to(root)
                yield Finding("source-link", f"a link to {target}", file=file.path)
    except OSError as error:
        raise SnapshotError(f"{snapshot.label}: it has changed meanwhile: {error}") from error


def _target(snapshot: Snapshot, record: FileRecord, there: set[str]) -> str | None:
    if record.size > _LONGEST_LINK:
        return None
    text = _bytes(snapshot.root / record.path, _LONGEST_LINK).decode("utf-8", "replace")
    if not text or not text.isprintable() or text != text.strip():
        return None
    if text.startswith(("../", "/")):
        return text
    beside = str(PurePosixPath(record.path).parent / text)
    return text if beside in there else None


def _papers(snapshot: Snapshot) -> Iterator[Finding]:
    top = {record.path.lower() for record in snapshot.files if "/" not in record.path}
    if "readme.md" not in top:
        yield Finding("card", "there is no README.md")
    licensed = any(name.startswith(("license", "licence", "copying")) for name in top)
    if not licensed and not _card_names_a_licence(snapshot.root):
        yield Finding("licence", "there is no LICENSE file, and README.md's head names none")


def _card_names_a_licence(root: Path) -> bool:
    try:
        with (root / "README.md").open(encoding="utf-8", errors="replace") as file:
            head = file.read(16_384)
    except OSError:
        return False
    block = head.split("\n---", 1)[0] if head.startswith("---") else ""
    return any(line.startswith("license:") for line in block.splitlines())
