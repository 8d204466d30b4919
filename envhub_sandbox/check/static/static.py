"""``Static``: all that is read of a repository without running it, put together and as JSON.

``undeclared`` says which of the imports nothing declares.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from types import MappingProxyType
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from envhub_sandbox.check.findings import Finding
from envhub_sandbox.check.static.survey import File, survey
from envhub_sandbox.dependencies import interpreters
from envhub_sandbox.dependencies.declared import DeclaredPackages, declared
from envhub_sandbox.dependencies.resolve import WORKERS
from envhub_sandbox.errors import RequirementError
from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.hub.sources import parsing
from envhub_sandbox.hub.sources.parsing import Import, imports
from envhub_worker.protocol.text import printable

_LONGEST = 500


@dataclass(frozen=True, kw_only=True)
class Static:
    """What was read; nothing of it ran.

    Attributes:
        entries: The arguments of each ``make_env`` at the top of the entry file, and its line.
        imports: What the entry file leads to and the repository does not have, by name.
        declared: What it declares; None where it says nothing, or nothing that can be taken.
        findings: What is worth a look.
    """

    snapshot: Snapshot
    files: list[File]
    entries: tuple[tuple[str, int], ...]
    imports: list[Import]
    declared: DeclaredPackages | None
    findings: list[Finding]

    @property
    def reference(self) -> str:
        """What was read, pinned."""
        return self.snapshot.reference

    @property
    def modules(self) -> dict[str, Import]:
        """Each module that is imported, with the first place."""
        return {one.name: one for one in reversed(self.imports)}

    def is_brought(self, module: str) -> bool:
        """Whether a package of a module's name is declared, or in every sandbox.

        Some packages have another name than their modules.
        """
        wanted = [one.requirement for one in self.declared.wanted] if self.declared else []
        names = {canonicalize_name(one.name) for one in [*wanted, *map(Requirement, WORKERS)]}
        return canonicalize_name(module) in names


def static(snapshot: Snapshot) -> Static:
    """Read a repository."""
    parsed = parsing.read(snapshot)
    surveyed = survey(snapshot, parsed)
    entry = parsed.get(snapshot.path)
    findings, says = surveyed.findings, None
    try:
        says = declared(snapshot.root, snapshot.path)
    except RequirementError as error:
        findings = [Finding("requirements", str(error)), *findings]
    return Static(
        snapshot=snapshot,
        files=surveyed.files,
        entries=() if entry is None else entry.entries,
        imports=imports(snapshot, parsed),
        declared=says,
        findings=sorted(map(_printable, findings), key=lambda one: one.check.severity.rank),
    )


def _printable(one: Finding) -> Finding:
    file, message = printable(one.file, _LONGEST), printable(one.message, _LONGEST)
    return replace(one, file=file, message=message)


def document(read: Static) -> dict[str, Any]:
    """All of it, as plain data."""
    says = read.declared
    return {
        "reference": read.reference,
        "entry": {
            "file": read.snapshot.path,
            "make_env": [{"arguments": text, "line": line} for text, line in read.entries],
        },
        "files": [
            {
                "path": one.record.path,
                "bytes": one.record.size,
                "hash": one.record.digest,
                "kind": one.kind,
            }
            for one in read.files
        ],
        "declared": says
        and {"source": says.source, "python": says.python, "packages": list(map(str, says.wanted))},
        "imports": [
            {
                "name": one.name,
                "file": one.file,
                "line": one.line,
                "brought": read.is_brought(name),
            }
            for name, one in sorted(read.modules.items())
        ],
        "findings": [one.document() for one in read.findings],
    }


def undeclared(
    found: list[Import],
    stated: Mapping[str, Requirement],
    packages: Path | None,
    taken: Mapping[str, str] = MappingProxyType({}),
) -> list[Finding]:
    """The imports that nothing declared brings along.

    Args:
        stated: What the repository declares, by canonical name.
        packages: The environment that was made of it; None where this interpreter serves.
        taken: Modules that were installed although nothing declares them, and what needs them.
    """
    brought = _of_this_interpreter({} if packages else stated)
    if packages:
        brought |= {path.name.partition(".")[0] for path in packages.iterdir()}
    missing = [one for one in found if one.name not in brought or one.name in taken]
    named = {one.name for one in missing}
    found_at = [(f"{one.name} is imported", one.file, one.line) for one in missing]
    found_at += [(where, "", 0) for module, where in taken.items() if module not in named]
    return [
        Finding("imports", f"{what}, and nothing declares it", "", file, line)
        for what, file, line in found_at
    ]


def _of_this_interpreter(declared: Mapping[str, Requirement]) -> set[str]:
    wanted = [*map(Requirement, WORKERS), *declared.values()]
    return {module for one in interpreters.brought(wanted) for module in _modules(one)}


def _modules(found: metadata.Distribution) -> set[str]:
    """What a distribution lets one import; Python 3.10 itself overlooks some of it."""
    named = (found.read_text("top_level.txt") or "").split()
    tops = {file.parts[0] for file in found.files or () if file.suffix in (".py", ".so")}
    return {*named, *(top.partition(".")[0] for top in tops)}
