"""What a snapshot's Python files say and import: each read once, and parsed in a bounded child.

A text can take hours of Python's parser, gigabytes, or its process. What becomes of the child is
no matter of ours: the file that ended it is one that cannot be read.

Nothing is imported or run. What is found in code is a hint for a person and no wall: who wants to
hide a call can. The walls are the sandbox's.
"""

from __future__ import annotations

import contextlib
import json
import os
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from envhub_sandbox.extras.sources import parser
from envhub_sandbox.hub.listing import Snapshot
from envhub_sandbox.system.platform import open_flags, own_variables

MOST_BYTES = 256 << 10
"""Of one file."""
MOST_BYTES_IN_ALL = 16 << 20
MOST_LOST = 4
"""Children; what is left then is not read."""
_PATIENCE_S = 600.0
"""For a child that neither computes nor ends, as nothing lets it; the bound is its CPU time."""


class ImportStatement(NamedTuple):
    """One statement of import.

    Attributes:
        level: Of a relative ``from``; -1 for ``import``.
        module: Behind ``from``.
        required: Whether the file does not work without: it is not within a ``try`` that goes on
            without it, nor for type checkers or for the file as a program.
        within: The function or class at the top of the file that it stands in; empty for none.
    """

    level: int
    module: str
    names: Sequence[str]
    required: bool
    line: int
    within: str = ""


@dataclass(frozen=True, kw_only=True)
class ParsedFile:
    """What a file says; each with its line at the end. Names are followed to their imports.

    Attributes:
        imports: In the order of a walk.
        uses: Dotted names, called or not; ``[computed]`` for what is got by a computed name.
        texts: ``"outside"`` with a text that names a place beyond, or ``"wordless"``; its length.
        entries: The arguments of each ``make_env``.
        ids: Texts such as ``"Ant-v5"``, or ``"Ant-v5 drawn"`` where it is made with a render mode.
        definitions: The functions and classes at the top, each with the names that it uses; an
            empty one for what is beside them.
        encoding: Where it is neither UTF-8 nor ASCII, and so has not been read: its name, or an
            empty one where there is none.
        is_python: Of this version.
        is_whole: Whether that is all; else there is more of a kind than is kept.
    """

    imports: tuple[ImportStatement, ...] = ()
    uses: tuple[tuple[str, int], ...] = ()
    texts: tuple[tuple[str, str, int, int], ...] = ()
    entries: tuple[tuple[str, int], ...] = ()
    ids: tuple[tuple[str, int], ...] = ()
    definitions: tuple[tuple[str, Sequence[str]], ...] = ()
    encoding: str | None = None
    is_python: bool = True
    is_whole: bool = True


def read(snapshot: Snapshot) -> dict[str, ParsedFile | None]:
    """Every Python file of a snapshot; None for those that have not been read.

    That is: larger than a person writes, beyond what all may take, or what the parser has not
    survived.
    """
    names = sorted(file.path for file in snapshot.files if file.path.endswith(".py"))
    found: dict[str, ParsedFile | None] = dict.fromkeys(names)
    left, texts = MOST_BYTES_IN_ALL, {}
    for name in names:
        data = content(snapshot.root / name, MOST_BYTES)
        if data is not None and len(data) <= left:
            left -= len(data)
            texts[name] = data
    return {**found, **parsed(texts)}


def content(path: Path, most: int) -> bytes | None:
    """A regular file's bytes; None if they are more, or it is none.

    It is opened once: what was looked at is what is read, and a link is not followed.
    """
    try:
        with open(path, "rb", opener=_open_no_link) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                return None
            data = file.read(most + 1)
    except OSError:
        return None
    return data if len(data) <= most else None


def _open_no_link(path: str, flags: int) -> int:
    return os.open(path, flags | open_flags("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC"))


def parsed(texts: Mapping[str, bytes]) -> dict[str, ParsedFile | None]:
    """What each text is; None where it was too much for a child."""
    found: dict[str, ParsedFile | None] = dict.fromkeys(texts)
    waiting = list(texts)
    for _ in range(MOST_LOST):
        if not waiting:
            break
        answers = list(_answers([texts[name] for name in waiting]))
        for name, answer in zip(waiting, answers, strict=False):
            found[name] = answer
        waiting = waiting[len(answers) + 1 :]  # the next one is what ended it
    return found


def _answers(texts: list[bytes]) -> Iterator[ParsedFile | None]:
    with tempfile.TemporaryFile() as given, tempfile.TemporaryFile() as taken:
        for text in texts:
            given.write(len(text).to_bytes(4, "big"))
            given.write(text)
        given.seek(0)
        with contextlib.suppress(subprocess.TimeoutExpired):  # what it has answered counts
            subprocess.run(
                [sys.executable, "-I", "-S", parser.__file__],
                stdin=given,
                stdout=taken,
                stderr=subprocess.DEVNULL,
                cwd="/",
                env=own_variables(),
                timeout=_PATIENCE_S,
                check=False,
            )
        taken.seek(0)
        for line in taken.read(parser.OUTPUT).split(b"\n")[:-1]:  # the last one may be cut off
            yield _answer(json.loads(line))


def _answer(row: Any) -> ParsedFile | None:
    if row is None:
        return None
    if not row or "encoding" in row:
        return ParsedFile(is_python=bool(row), **row)
    whole = row.pop("is_whole")
    found: dict[str, Any] = {kind: tuple(map(tuple, rows)) for kind, rows in row.items()}
    found["imports"] = tuple(ImportStatement(*statement) for statement in row["imports"])
    return ParsedFile(is_whole=whole, **found)


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
    return sorted(found, key=attrgetter("file", "line", "name"))


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
        for statement in parsed.imports:
            if statement.required and (not statement.within or statement.within in self._used):
                for module, own in _targets(statement, file, self._names):
                    name = module.partition(".")[0]
                    if own in self._parsed:
                        self.files.add(own)
                    elif not own and name and name not in sys.stdlib_module_names:
                        self.imports.add(Import(name, file, statement.line, module))


def _targets(statement: ImportStatement, file: str, files: set[str]) -> Iterator[tuple[str, str]]:
    """Each module that is named, and the repository's own file if it is one."""
    folder, dotted = named_modules(statement, file)
    for number, name in enumerate(dotted):
        own = next((path for path in candidates(name, folder) if path in files), "")
        foreign = statement.level < 0 or (statement.level == 0 and number == 0)
        first = name.partition(".")[0]
        if own or (foreign and files.isdisjoint(candidates(first, folder))):
            yield name, own


def named_modules(statement: ImportStatement, file: str) -> tuple[str, list[str]]:
    """The folder that a statement in a file is about, and what it may import, dotted; first what
    it surely does.
    """
    folder = file.rpartition("/")[0]
    for _ in range(statement.level - 1):
        folder = folder.rpartition("/")[0]
    if statement.level < 0:
        return folder, list(statement.names)
    names = dict.fromkeys(f"{statement.module}.{name}".strip(".") for name in statement.names)
    return folder, [statement.module, *names]


def candidates(name: str, folder: str) -> Iterator[str]:
    """The files that a module's name can mean in a file of this folder."""
    path = name.replace(".", "/")
    for below in dict.fromkeys((folder, "", "src")):
        base = f"{below}/{path}".strip("/")
        yield from (f"{base}.py", f"{base}/__init__.py")


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
    own = {module: [module] for sign, *names in rows if sign == "=" for module in names}
    return own | {
        module: [] if names == ["-"] else names for module, *names in rows if module != "="
    }
