"""``Static``: everything that is read from a repository without running it, also as JSON.

``survey`` finds the kind of each file and its suspicious contents. Findings are hints for people:
an author can hide a call, and only the sandbox protects. Unread files are findings, too.
``undeclared`` lists imports that no declared package brings.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata
from operator import attrgetter
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from envhub_sandbox.errors import DependencyError, SnapshotError
from envhub_sandbox.extras.judge import contents
from envhub_sandbox.extras.judge.findings import Finding, Report
from envhub_sandbox.extras.packages import interpreters
from envhub_sandbox.extras.packages.declared import DeclaredPackages, declared
from envhub_sandbox.extras.packages.resolution.resolve import WORKERS
from envhub_sandbox.extras.sources import parsing
from envhub_sandbox.extras.sources.checkout import Checkout, is_unread
from envhub_sandbox.extras.sources.parsing import MOST_BYTES, Import, ParsedFile, imports
from envhub_sandbox.hub.listing import FileRecord
from envhub_sandbox.hub.local import IGNORED, REPOSITORY, LocalFolder
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_worker.protocol.text import counted, first_of

_MOST_BYTES_OF_TEXT = 1 << 20
_MOST_BYTES_IN_ALL = 32 << 20
_MOST_OF_A_FILE = 100
_MOST = 20_000
"""Findings to keep: the limit of files is the same."""
_LONGEST_LINK = 1024
_SHOWN_IGNORED = 10


@dataclass(frozen=True)
class File:
    """One file. ``kind``: such as ``"Python"``, ``"text"``, ``"binary"``, ``"machine code"``."""

    record: FileRecord
    kind: str


def survey(
    snapshot: Snapshot, parsed: Mapping[str, ParsedFile | None], report: Report
) -> list[File]:
    """Examines every file of a repository, and the result of ``parsing.read``; adds the suspicious
    contents to a report.
    """

    def add(findings: Iterable[Finding]) -> None:
        for finding in findings:
            report.add(finding)

    files: list[File] = []
    if snapshot.repo_type != "pypi":  # its only file is ours
        add(_papers(snapshot))
    add(_in_place(snapshot))
    add(_in_front(snapshot))
    left, unread = _MOST_BYTES_IN_ALL, 0
    for record in sorted(snapshot.files, key=attrgetter("path")):
        path = snapshot.root / record.path
        ending = bytes_of(path, contents.ENDING, max(record.size - contents.ENDING, 0))
        kind = contents.kind_of_contents(record.path, bytes_of(path, contents.BEGINNING), ending)
        files.append(File(record, kind))
        add(contents.of_kind(record.path, kind, is_folder=snapshot.is_local))
        for finding in contents.hidden(record.path, record.path, is_code=True):
            add([Finding(finding.id, f"its name {finding.message}", file=record.path)])
        if record.path in parsed:
            add(_in_code(record, parsed[record.path]))
        if parsed.get(record.path) is not None:
            add(_in_text(record, path, is_code=True))
        elif kind in ("Python", "text") and record.size <= min(left, _MOST_BYTES_OF_TEXT):
            left -= record.size
            add(_in_text(record, path, is_code=kind == "Python"))
        else:
            unread += kind == "text"
    if unread:
        texts = counted(unread, "text is", "texts are")
        message = f"{texts} more than is read: 1 MiB of a file, and 32 MiB in all"
        add([Finding("source-unread", message)])
    return files


def bytes_of(path: Path, most: int, start: int = 0) -> bytes:
    """Returns a part of a file; empty for an unreadable file."""
    try:
        with path.open("rb") as file:
            file.seek(start)
            return file.read(most)
    except OSError:
        return b""


def _in_text(record: FileRecord, path: Path, *, is_code: bool) -> Iterator[Finding]:
    text = bytes_of(path, record.size).decode("utf-8-sig", "replace")
    yield from contents.hidden(record.path, text, is_code=is_code)
    if is_code:
        yield from contents.long_lines(record.path, text)


def _in_code(record: FileRecord, parsed: ParsedFile | None) -> Iterator[Finding]:
    if parsed is None:
        larger = f"it is larger than {MOST_BYTES >> 10} KiB"
        other = "it is more than can be read of a file, or of a repository"
        message = larger if record.size > MOST_BYTES else other
        yield Finding("source-unparsed", message, file=record.path)
        return
    if not parsed.is_python:
        yield _unread(record, "it is not Python of this version")
    if parsed.encoding is not None:
        named = f"Python reads it as {parsed.encoding}" if parsed.encoding else "it is not UTF-8"
        yield Finding("source-encoding", f"{named}, and it has not been read", file=record.path)
    found = contents.constructs(record.path, parsed)
    yield from itertools.islice(found, _MOST_OF_A_FILE)
    if next(found, None) is not None:
        yield _unread(record, f"there is more in it than the first {_MOST_OF_A_FILE} findings")
    elif not parsed.is_whole:
        yield _unread(record, "it imports or names more than is kept of a file")


def _unread(record: FileRecord, why: str) -> Finding:
    return Finding("source-unread", why, file=record.path)


def _in_place(snapshot: Snapshot) -> Iterator[Finding]:
    """Yields findings about links, and about a folder that differs from its commit."""
    if not snapshot.is_local:
        yield from _links(snapshot)
        return
    try:
        folder = LocalFolder.of(snapshot)
        if not isinstance(folder.checkout, Checkout):
            # links that the copy of a folder followed; their targets lie inside the folder
            for file in folder.files():
                if file.source != folder.root / file.path:
                    target = file.source.relative_to(folder.root)
                    yield Finding("source-link", f"a link to {target}", file=file.path)
            if is_unread(folder.root):
                message = "git cannot say what its commit has: is it installed? Are its ids SHA-1?"
                yield Finding("source-uncommitted", message)
        else:
            yield from _links(snapshot)
            yield from _uncommitted(folder.checkout, snapshot)
        yield from _left_out(folder)
    except OSError as error:
        raise SnapshotError(f"{snapshot.label}: it has changed meanwhile: {error}") from error


def _links(snapshot: Snapshot) -> Iterator[Finding]:
    """Finds git's links, which the Hub, and so a checkout, stores as files with their target."""
    paths = {record.path for record in snapshot.files}
    paths |= {str(parent) for path in paths for parent in PurePosixPath(path).parents}
    for record in snapshot.files:
        target = _target(snapshot, record, paths)
        if target is not None:
            message = f"reads like a link of git's, to {target}"
            yield Finding("source-link", message, file=record.path)


def _uncommitted(checkout: Checkout, snapshot: Snapshot) -> Iterator[Finding]:
    for name in checkout.held_back:
        message = "git does not look at it for changes, so its commit may have another version"
        yield Finding("source-uncommitted", message, file=name)
    for name, attribute in checkout.converted(record.path for record in snapshot.files):
        message = f"git commits it with other bytes, by {attribute} in .gitattributes"
        yield Finding("source-uncommitted", message, file=name)


def _left_out(here: LocalFolder) -> Iterator[Finding]:
    left: dict[str, list[str]] = {}
    for item in here.left_out():
        if item.why == REPOSITORY:
            message = "a git repository of its own: the commit around it has none of its files"
            yield Finding("source-uncommitted", message, file=item.path)
        else:
            left.setdefault(item.why, []).append(item.path)
    for why, paths in left.items():
        shown = ", ".join(first_of(paths, _SHOWN_IGNORED))
        begin = "git leaves out" if why == IGNORED else f"left out, {why}:"
        yield Finding("source-ignored", f"{begin} {shown}")


def _in_front(snapshot: Snapshot) -> Iterator[Finding]:
    """Finds extension modules that Python imports instead of the source beside them."""
    paths = {record.path for record in snapshot.files}
    for path in sorted(path for path in paths if path.endswith(".so")):
        folder, slash, name = path.rpartition("/")
        module = name.partition(".")[0]
        sources = [f"{folder}{slash}{module}.py"]
        if folder and module == "__init__":  # a package wins over a module of its name
            sources.append(f"{folder}.py")
        for source in filter(paths.__contains__, sources):
            message = f"machine code that runs in place of {source}"
            yield Finding("source-compiled", message, file=path)


def _target(snapshot: Snapshot, record: FileRecord, there: set[str]) -> str | None:
    if record.size > _LONGEST_LINK:
        return None
    text = bytes_of(snapshot.root / record.path, _LONGEST_LINK).decode("utf-8", "replace")
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


@dataclass(frozen=True, kw_only=True)
class Static:
    """The result of reading a repository; none of its code ran.

    Attributes:
        entries: The arguments and the line of each ``make_env`` at the top of the entry file.
        imports: Imports that the entry file leads to and the repository lacks, by name.
        declared: Its declared packages; None if it declares none, or none that are supported.
        findings: Suspicious contents.
    """

    snapshot: Snapshot
    files: list[File]
    entries: tuple[tuple[str, int], ...]
    imports: list[Import]
    declared: DeclaredPackages | None
    findings: list[Finding]

    @property
    def reference(self) -> str:
        """Returns the pinned reference."""
        return self.snapshot.reference

    @property
    def modules(self) -> dict[str, Import]:
        """Returns each imported module, with its first import."""
        return {statement.name: statement for statement in reversed(self.imports)}

    def is_brought(self, module: str) -> bool:
        """Tells whether a module's name is that of a declared package, or of one in every sandbox.

        Some packages have another name than their modules.
        """
        wanted = [package.requirement for package in self.declared.wanted] if self.declared else []
        names = {
            canonicalize_name(requirement.name)
            for requirement in [*wanted, *map(Requirement, WORKERS)]
        }
        return canonicalize_name(module) in names


def static(snapshot: Snapshot) -> Static:
    """Reads a repository without running it."""
    parsed = parsing.read(snapshot)
    report, says = Report(snapshot.reference, most=_MOST), None
    try:
        says = declared(snapshot.root, snapshot.path)
    except DependencyError as error:
        report.add(Finding("requirements", str(error)))
    files = survey(snapshot, parsed, report)
    if report.left_out:
        report.add(Finding("source-unread", "there is more to find than is kept"))
    entry = parsed.get(snapshot.path)
    return Static(
        snapshot=snapshot,
        files=files,
        entries=() if entry is None else entry.entries,
        imports=imports(snapshot, parsed),
        declared=says,
        findings=report.findings,
    )


def document(read: Static) -> dict[str, Any]:
    """Returns the result as plain data."""
    says = read.declared
    return {
        "reference": read.reference,
        "entry": {
            "file": read.snapshot.path,
            "make_env": [{"arguments": text, "line": line} for text, line in read.entries],
        },
        "files": [
            {
                "path": file.record.path,
                "bytes": file.record.size,
                "hash": file.record.digest,
                "kind": file.kind,
            }
            for file in read.files
        ],
        "declared": says
        and {"source": says.source, "python": says.python, "packages": list(map(str, says.wanted))},
        "imports": [
            {"name": one.name, "file": one.file, "line": one.line, "brought": read.is_brought(name)}
            for name, one in sorted(read.modules.items())
        ],
        "findings": [finding.document() for finding in read.findings],
    }


def undeclared(
    found: list[Import],
    stated: Mapping[str, Requirement],
    packages: Path | None,
    taken: Mapping[str, str] = MappingProxyType({}),
) -> list[Finding]:
    """Finds imports that no declared package brings.

    Args:
        stated: The repository's declared requirements, by canonical name.
        packages: The environment made from them; None if this interpreter serves.
        taken: Modules installed although undeclared, and the packages that need them.
    """
    wanted = [*map(Requirement, WORKERS), *({} if packages else stated).values()]
    brought = {
        module for distribution in interpreters.brought(wanted) for module in _modules(distribution)
    }
    if packages:
        brought |= {path.name.partition(".")[0] for path in packages.iterdir()}
    missing = [
        statement for statement in found if statement.name not in brought or statement.name in taken
    ]
    named = {statement.name for statement in missing}
    found_at = [
        (f"{statement.name} is imported", statement.file, statement.line) for statement in missing
    ]
    found_at += [(where, "", 0) for module, where in taken.items() if module not in named]
    return [
        Finding("imports", f"{what}, and nothing declares it", "", file, line)
        for what, file, line in found_at
    ]


def _modules(found: metadata.Distribution) -> set[str]:
    """Returns the modules of a distribution; Python 3.10's own function misses some."""
    named = (found.read_text("top_level.txt") or "").split()
    tops = {file.parts[0] for file in found.files or () if file.suffix in (".py", ".so")}
    return {*named, *(top.partition(".")[0] for top in tops)}
