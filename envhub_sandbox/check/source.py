"""What a repository's files say, read as data: imports, licence, and what is worth a look.

Nothing is imported or run. What is found in code is a hint for a person and no wall: who wants to
hide a call can. The walls are the sandbox's.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

from envhub_sandbox.check.findings import Finding
from envhub_sandbox.check.parsing import Named, Parsed
from envhub_sandbox.dependencies import host
from envhub_sandbox.dependencies.resolve import WORKERS
from envhub_sandbox.hub.snapshot import Snapshot

Files = Mapping[str, Parsed | None]
_MOST_CONSTRUCTS = 100
"""Of one file."""
_NATIVE = (".so", ".dylib", ".dll", ".pyd", ".o", ".a")
_MODULES = {
    **dict.fromkeys(
        ("socket", "ssl", "http", "urllib", "requests", "httpx", "aiohttp", "ftplib", "smtplib"),
        "source-network",
    ),
    **dict.fromkeys(("subprocess", "pty"), "source-process"),
    **dict.fromkeys(("pickle", "dill", "joblib", "cloudpickle", "marshal"), "source-pickle"),
    **dict.fromkeys(("ctypes", "cffi"), "source-native"),
}
_CALLS = {
    **dict.fromkeys(("eval", "exec", "compile", "__import__"), "source-dynamic"),
    **dict.fromkeys(("os.system", "os.popen", "os.execv", "os.fork"), "source-process"),
    "torch.load": "source-pickle",
}


@dataclass(frozen=True)
class Import:
    """A module that is imported: its first name, and where."""

    name: str
    file: str
    line: int


def look(snapshot: Snapshot, files: Files) -> list[Finding]:
    """What is worth a look before anything is run.

    Args:
        snapshot: The repository.
        files: What ``parsing.read`` read of it.
    """
    names = {record.path for record in snapshot.files}
    found = [*_papers(snapshot, names)]
    for name in sorted(names):
        if name.endswith(_NATIVE):
            found.append(Finding("source-native", "a file of machine code", file=name))
        else:
            constructs = _constructs(name, files.get(name))
            found += itertools.islice(constructs, _MOST_CONSTRUCTS)
    return found


def _papers(snapshot: Snapshot, names: set[str]) -> Iterator[Finding]:
    top = {name.lower() for name in names if "/" not in name}
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


def _constructs(file: str, parsed: Parsed | None) -> Iterator[Finding]:
    if parsed is None:
        return
    for one in parsed.imports:
        for name in _firsts(one):
            if check := _MODULES.get(name):
                yield Finding(check, f"imports {name}", file=file, line=one.line)
    for called, line in parsed.calls:
        if check := _CALLS.get(called):
            yield Finding(check, f"calls {called}", file=file, line=line)


def _firsts(one: Named) -> list[str]:
    if one.level < 0:
        return [name.partition(".")[0] for name in one.names]
    return [] if one.level else [one.module.partition(".")[0]]


# --- imports -----------------------------------------------------------------------------------


def imports(snapshot: Snapshot, files: Files) -> list[Import]:
    """What the entry file imports, and the repository's own modules that it leads to.

    What is imported within ``try`` may be missing, and what nobody imports is not needed.
    """
    names = {record.path for record in snapshot.files}
    waiting, seen, found = [snapshot.path], {snapshot.path}, []
    while waiting:
        file = waiting.pop()
        parsed = files.get(file)
        for one in () if parsed is None else parsed.imports:
            for name, own in _targets(one, file, names) if one.unguarded else ():
                if own and own not in seen:
                    seen.add(own)
                    waiting.append(own)
                elif not own and name and name not in sys.stdlib_module_names:
                    found.append(Import(name, file, one.line))
    return sorted(set(found), key=lambda one: (one.file, one.line, one.name))


def _targets(one: Named, file: str, files: set[str]) -> Iterator[tuple[str, str]]:
    """Each module that is named: its first name, and the repository's own file if it is one."""
    folder = file.rpartition("/")[0]
    for _ in range(one.level - 1):
        folder = folder.rpartition("/")[0]
    dotted = list(one.names)
    if one.level >= 0:
        names = dict.fromkeys(f"{one.module}.{name}".strip(".") for name in one.names)
        dotted = [one.module, *names]
    for number, name in enumerate(dotted):
        own = _own(name, folder, files)
        foreign = one.level < 0 or (one.level == 0 and number == 0)
        is_package = _own(name.partition(".")[0], folder, files)
        if own or (foreign and not is_package):
            yield name.partition(".")[0], own


def _own(name: str, folder: str, files: set[str]) -> str:
    path = name.replace(".", "/")
    for below in dict.fromkeys((folder, "", "src")):
        base = f"{below}/{path}".strip("/")
        for candidate in (f"{base}.py", f"{base}/__init__.py"):
            if candidate in files:
                return candidate
    return ""


def undeclared(
    found: list[Import], declared: Mapping[str, Requirement], packages: Path | None
) -> list[Finding]:
    """The imports that nothing declared brings along.

    Args:
        found: What is imported.
        declared: What the repository declares, by canonical name.
        packages: The environment that was made of it; None where this interpreter serves.
    """
    brought = _in_folder(packages) if packages else _of_this_interpreter(declared)
    return [
        Finding(
            "imports", f"{one.name} is imported, and nothing declares it", "", one.file, one.line
        )
        for one in found
        if one.name not in brought
    ]


def _in_folder(packages: Path) -> set[str]:
    brought = {path.name.partition(".")[0] for path in packages.iterdir()}
    return brought | _of_this_interpreter({})


def _of_this_interpreter(declared: Mapping[str, Requirement]) -> set[str]:
    wanted = [*map(Requirement, WORKERS), *declared.values()]
    return {module for one in host.brought(wanted) for module in _modules(one)}


def _modules(found: metadata.Distribution) -> set[str]:
    """What a distribution lets one import; Python 3.10 itself overlooks some of it."""
    named = (found.read_text("top_level.txt") or "").split()
    tops = {file.parts[0] for file in found.files or () if file.suffix in (".py", ".so")}
    return {*named, *(top.partition(".")[0] for top in tops)}
