"""What a repository's code imports, read as data.

Nothing is imported or run. What is found in code is a hint for a person and no wall: who wants to
hide a call can. The walls are the sandbox's.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from envhub_sandbox.hub.snapshot import Snapshot
from envhub_sandbox.hub.sources.parsing import ImportStatement, ParsedFile

Files = Mapping[str, ParsedFile | None]


_MOST_ROUNDS = 100


@dataclass(frozen=True)
class Import:
    """A module that is imported: its first name, where, and its whole name."""

    name: str
    file: str
    line: int
    module: str = ""


def imports(snapshot: Snapshot, files: Files) -> list[Import]:
    """What the entry file imports, and the repository's own modules that it leads to.

    A function's or class's own imports count if something that runs uses its name, as far as the
    text says. What may be missing does not count, nor what nothing leads to.
    """
    found = _ImportWalk(snapshot, files).imports
    return sorted(found, key=lambda one: (one.file, one.line, one.name))


def ids(snapshot: Snapshot, files: Files) -> list[tuple[str, str, int]]:
    """Texts such as ``"Ant-v5"`` in the entry file and what it leads to, with file and line."""
    reached = sorted(_ImportWalk(snapshot, files).files)
    return [
        (text, file, line) for file in reached if (one := files[file]) for text, line in one.ids
    ]


class _ImportWalk:
    """What runs where ``make_env`` does, by the names that it uses."""

    def __init__(self, snapshot: Snapshot, files: Files) -> None:
        self._parsed = files
        self._names = {record.path for record in snapshot.files}
        self._used = {"make_env"}
        self.files = {snapshot.path} & files.keys()
        self.imports: set[Import] = set()
        for _ in range(_MOST_ROUNDS):
            before = len(self.files), len(self._used)
            for file in sorted(self.files):
                self._follow(file)
            if (len(self.files), len(self._used)) == before:
                return

    def _follow(self, file: str) -> None:
        parsed = self._parsed[file] or ParsedFile()
        for name, used in parsed.definitions:
            if not name or name in self._used:
                self._used.update(used)
        for one in parsed.imports:
            if one.required and (not one.within or one.within in self._used):
                for module, own in _targets(one, file, self._names):
                    name = module.partition(".")[0]
                    if own in self._parsed:
                        self.files.add(own)
                    elif not own and name and name not in sys.stdlib_module_names:
                        self.imports.add(Import(name, file, one.line, module))


def _targets(one: ImportStatement, file: str, files: set[str]) -> Iterator[tuple[str, str]]:
    """Each module that is named, and the repository's own file if it is one."""
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
            yield name, own


def _own(name: str, folder: str, files: set[str]) -> str:
    path = name.replace(".", "/")
    for below in dict.fromkeys((folder, "", "src")):
        base = f"{below}/{path}".strip("/")
        for candidate in (f"{base}.py", f"{base}/__init__.py"):
            if candidate in files:
                return candidate
    return ""


def of_module(name: str) -> list[str]:
    """The distributions that bring a module, the usual one first; empty where none is known."""
    table = _table()
    while name and name not in table:
        name = name.rpartition(".")[0]
    return table.get(name, [])


@cache
def _table() -> dict[str, list[str]]:
    text = Path(__file__).with_name("modules.txt").read_text("utf-8")
    rows = [line.split() for line in text.splitlines() if not line.startswith("#")]
    return {module: [] if names == ["-"] else names or [module] for module, *names in rows}
