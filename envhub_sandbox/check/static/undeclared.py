"""Whether what a repository imports is declared."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from types import MappingProxyType

from packaging.requirements import Requirement

from envhub_sandbox.check.findings import Finding
from envhub_sandbox.dependencies import installed
from envhub_sandbox.dependencies.resolve import WORKERS
from envhub_sandbox.sources.imports import Import


def undeclared(
    found: list[Import],
    declared: Mapping[str, Requirement],
    packages: Path | None,
    taken: Mapping[str, str] = MappingProxyType({}),
) -> list[Finding]:
    """The imports that nothing declared brings along.

    Args:
        found: What is imported.
        declared: What the repository declares, by canonical name.
        packages: The environment that was made of it; None where this interpreter serves.
        taken: Modules that were installed although nothing declares them, and what needs them.
    """
    brought = _in_folder(packages) if packages else _of_this_interpreter(declared)
    missing = [one for one in found if one.name not in brought or one.name in taken]
    named = {one.name for one in missing}
    return [
        *(_finding(f"{one.name} is imported", one.file, one.line) for one in missing),
        *(_finding(where) for module, where in taken.items() if module not in named),
    ]


def _finding(what: str, file: str = "", line: int = 0) -> Finding:
    return Finding("imports", f"{what}, and nothing declares it", "", file, line)


def _in_folder(packages: Path) -> set[str]:
    brought = {path.name.partition(".")[0] for path in packages.iterdir()}
    return brought | _of_this_interpreter({})


def _of_this_interpreter(declared: Mapping[str, Requirement]) -> set[str]:
    wanted = [*map(Requirement, WORKERS), *declared.values()]
    return {module for one in installed.brought(wanted) for module in _modules(one)}


def _modules(found: metadata.Distribution) -> set[str]:
    """What a distribution lets one import; Python 3.10 itself overlooks some of it."""
    named = (found.read_text("top_level.txt") or "").split()
    tops = {file.parts[0] for file in found.files or () if file.suffix in (".py", ".so")}
    return {*named, *(top.partition(".")[0] for top in tops)}
