"""Reads the imports and contents of a snapshot's Python files: each once, in a bounded child.

A hostile text can cost Python's parser hours or gigabytes, or crash it. Then only the child dies,
and the file counts as unreadable.

Nothing is imported or run. Findings in code are hints for people: an author can hide a call, and
only the sandbox protects.
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
from operator import attrgetter
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple

from envhub_sandbox.extras.sources import parser
from envhub_sandbox.hub.listing import Snapshot
from envhub_sandbox.system.platform import open_flags, own_variables

MOST_BYTES = 256 << 10
"""Bytes of one file."""
MOST_BYTES_IN_ALL = 16 << 20
MOST_LOST = 4
"""Children that may die; the remaining files stay unread."""
_PATIENCE_S = 600.0
"""Seconds for all children. Normally its CPU limit ends one that computes for long."""


class ImportStatement(NamedTuple):
    """An import statement.

    Attributes:
        level: The level of a relative ``from``; -1 for ``import``.
        module: The name after ``from``.
        required: Whether the file fails without the import: it is not in a ``try`` that handles its
            failure, and not only for type checkers or for the file as a program.
        within: The top-level function or class around the statement; empty for none.
    """

    level: int
    module: str
    names: Sequence[str]
    required: bool
    line: int
    within: str = ""


@dataclass(frozen=True, kw_only=True)
class ParsedFile:
    """The content of a file; each row ends with its line. Names are followed to their imports.

    Attributes:
        imports: In the order of a walk.
        uses: Dotted names, called or not; ``[computed]`` for an attribute with a computed name.
        texts: ``"outside"`` with a text that names a place outside, or ``"wordless"``; its length.
        entries: The arguments of each ``make_env``.
        ids: Texts such as ``"Ant-v5"``, or ``"Ant-v5 drawn"`` if made with a render mode.
        definitions: The top-level functions and classes, each with the names that it uses; an
            empty name for the code outside of them.
        encoding: The name of an encoding other than UTF-8 and ASCII, whose file stays unread; empty
            if the encoding does not exist.
        is_python: Whether it is Python of this version.
        is_whole: Whether the rows are complete; else a kind exceeded its limit.
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
    """Reads every Python file of a snapshot; None for files that stay unread.

    These are files beyond the size that a person writes or beyond the size of all files, and files
    that crashed the parser.
    """
    names = sorted(file.path for file in snapshot.files if file.path.endswith(".py"))
    parsed_files: dict[str, ParsedFile | None] = dict.fromkeys(names)
    left, texts = MOST_BYTES_IN_ALL, {}
    for name in names:
        data = content(snapshot.root / name, MOST_BYTES)
        if data is not None and len(data) <= left:
            left -= len(data)
            texts[name] = data
    return {**parsed_files, **parsed(texts)}


def content(path: Path, most: int) -> bytes | None:
    """Returns a regular file's bytes; None for other files, or if there are more than ``most``.

    Opens the file once, so that the checked file is the one that is read; follows no link.
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
    """Parses each text; None for a text that cost a child too much."""
    parsed_files: dict[str, ParsedFile | None] = dict.fromkeys(texts)
    waiting, deadline = list(texts), monotonic() + _PATIENCE_S
    for _ in range(MOST_LOST):
        if not waiting or (left_s := deadline - monotonic()) <= 0:
            break
        answers = list(_answers([texts[name] for name in waiting], left_s))
        for name, answer in zip(waiting, answers, strict=False):
            parsed_files[name] = answer
        waiting = waiting[len(answers) + 1 :]  # the next text ended the child
    return parsed_files


def _answers(texts: list[bytes], left_s: float) -> Iterator[ParsedFile | None]:
    with tempfile.TemporaryFile() as given, tempfile.TemporaryFile() as taken:
        for text in texts:
            given.write(len(text).to_bytes(4, "big"))
            given.write(text)
        given.seek(0)
        with contextlib.suppress(subprocess.TimeoutExpired):  # its answers before the timeout count
            subprocess.run(
                [sys.executable, "-I", "-S", parser.__file__],
                stdin=given,
                stdout=taken,
                stderr=subprocess.DEVNULL,
                cwd="/",
                env=own_variables(),
                timeout=left_s,
                check=False,
            )
        taken.seek(0)
        for line in taken.read(parser.OUTPUT).split(b"\n")[:-1]:  # the last line may be cut off
            yield _answer(json.loads(line))


def _answer(row: Any) -> ParsedFile | None:
    if row is None:
        return None
    if not row or "encoding" in row:
        return ParsedFile(is_python=bool(row), **row)
    is_whole = row.pop("is_whole")
    fields: dict[str, Any] = {kind: tuple(map(tuple, rows)) for kind, rows in row.items()}
    fields["imports"] = tuple(ImportStatement(*statement) for statement in row["imports"])
    return ParsedFile(is_whole=is_whole, **fields)


Files = Mapping[str, ParsedFile | None]


_MOST_IMPORTED = 100_000
"""Names in all import statements that are followed."""
_Part = tuple[str, ImportStatement | Sequence[str]]
"""The name of a file, or of a function or class; and an import statement in it, or the names that
its code uses.
"""


@dataclass(frozen=True)
class Import:
    """An imported module: its first name, the place of the import, and its whole name."""

    name: str
    file: str
    line: int
    module: str = ""


def imports(snapshot: Snapshot, files: Files) -> list[Import]:
    """Lists the imports of the entry file, and of the repository's modules that it leads to.

    The imports in a function or class count if code that runs uses its name, as far as the text
    shows. Optional imports and unreachable modules do not count.
    """
    found = _ImportWalk(snapshot, files).imports
    return sorted(found, key=attrgetter("file", "line", "name"))


def ids(snapshot: Snapshot, files: Files) -> list[tuple[str, str, int]]:
    """Lists texts such as ``"Ant-v5"`` in the entry file and the files it leads to, with places."""
    reached = sorted(_ImportWalk(snapshot, files).files)
    return [
        (text, file, line) for file in reached if (one := files[file]) for text, line in one.ids
    ]


class _ImportWalk:
    """Follows the code that runs with ``make_env``, by the names that it uses, each file once.

    What runs only if a name is used waits until the name is used.
    """

    def __init__(self, snapshot: Snapshot, files: Files) -> None:
        self._parsed = files
        self._names = {record.path for record in snapshot.files}
        self._used = {"make_env"}
        self._unused: dict[str, list[_Part]] = {}  # by the name that they wait for
        self._left = _MOST_IMPORTED
        self.files: set[str] = set()
        self.imports: set[Import] = set()
        self._walk([snapshot.path] if snapshot.path in files else [])

    def _walk(self, files: list[str]) -> None:
        names: list[str] = []
        while (files or names) and self._left > 0:
            parts = self._read(files.pop()) if files else self._unused.pop(names.pop(), ())
            for file, part in parts:
                if isinstance(part, ImportStatement):
                    files += self._follow(part, file)
                else:
                    names += [name for name in part if name not in self._used]
                    self._used.update(part)

    def _read(self, file: str) -> list[_Part]:
        """Returns the parts of a new file that run."""
        if file in self.files:
            return []
        self.files.add(file)
        parsed, runs = self._parsed[file] or ParsedFile(), list[_Part]()
        named: list[_Part] = [*parsed.definitions]
        named += [(one.within, one) for one in parsed.imports if one.required]
        for name, part in named:
            waits = name and name not in self._used
            (self._unused.setdefault(name, []) if waits else runs).append((file, part))
        return runs

    def _follow(self, statement: ImportStatement, file: str) -> Iterator[str]:
        """Notes what a statement imports; yields the repository's own files among it."""
        self._left -= len(statement.names) + 1
        for module, own in _targets(statement, file, self._names):
            name = module.partition(".")[0]
            if own in self._parsed:
                yield own
            elif not own and name and name not in sys.stdlib_module_names:
                self.imports.add(Import(name, file, statement.line, module))


def _targets(statement: ImportStatement, file: str, files: set[str]) -> Iterator[tuple[str, str]]:
    """Yields each module in a statement, and the repository's own file of that name, if any."""
    folder, dotted = named_modules(statement, file)
    for number, name in enumerate(dotted):
        own = next((path for path in candidates(name, folder) if path in files), "")
        foreign = statement.level < 0 or (statement.level == 0 and number == 0)
        first = name.partition(".")[0]
        if own or (foreign and files.isdisjoint(candidates(first, folder))):
            yield name, own


def named_modules(statement: ImportStatement, file: str) -> tuple[str, list[str]]:
    """Returns the folder that a statement refers to, and the dotted names that it may import; first
    the name that it always imports.
    """
    folder = file.rpartition("/")[0]
    for _ in range(statement.level - 1):
        folder = folder.rpartition("/")[0]
    if statement.level < 0:
        return folder, list(statement.names)
    names = dict.fromkeys(f"{statement.module}.{name}".strip(".") for name in statement.names)
    return folder, [statement.module, *names]


def candidates(name: str, folder: str) -> Iterator[str]:
    """Yields the files that a module's name may mean in a file of this folder."""
    path = name.replace(".", "/")
    for below in dict.fromkeys((folder, "", "src")):
        base = f"{below}/{path}".strip("/")
        yield from (f"{base}.py", f"{base}/__init__.py")
