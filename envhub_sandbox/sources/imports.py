"""What a repository's code imports, read as data.

Nothing is imported or run. What is found in code is a hint for a person and no wall: who wants to
hide a call can. The walls are the sandbox's.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.sources.parsing import Named, Parsed

Files = Mapping[str, Parsed | None]


@dataclass(frozen=True)
class Import:
    """A module that is imported: its first name, and where."""

    name: str
    file: str
    line: int


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
