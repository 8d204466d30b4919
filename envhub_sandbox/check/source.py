"""What a repository's files say, read as data: imports, licence, and what is worth a look.

Nothing is imported or run. What is found in code is a hint for a person and no wall: who wants to
hide a call can. The walls are the sandbox's.
"""

from __future__ import annotations

import ast
import itertools
import sys
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

from envhub_sandbox.check.findings import Finding
from envhub_sandbox.dependencies import host
from envhub_sandbox.dependencies.resolve import WORKERS
from envhub_sandbox.hub.snapshot import Snapshot

_MOST_BYTES = 256 << 10
"""Of one file: Python's parser takes a thousand bytes of memory for one of a hostile text."""
_MOST_BYTES_IN_ALL = 16 << 20
_MOST_CONSTRUCTS = 100
"""Of one file."""
_LONGEST_NAME = 1024
"""Of a module, as a path of a file can be."""
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


def look(snapshot: Snapshot) -> list[Finding]:
    """What is worth a look before anything is run."""
    names = {record.path for record in snapshot.files}
    found = [*_papers(snapshot, names)]
    left = _MOST_BYTES_IN_ALL
    for record in sorted(snapshot.files, key=lambda one: one.path):
        name = record.path
        if name.endswith(_NATIVE):
            found.append(Finding("source-native", "a file of machine code", file=name))
        elif name.endswith(".py") and record.size <= left:
            left -= record.size
            constructs = _constructs(name, parsed(snapshot.root / name))
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


def parsed(path: Path) -> ast.Module | None:
    """A file's tree; None of what is too large or no Python (of this version)."""
    try:
        if path.stat().st_size > _MOST_BYTES:
            return None
        # as text: of bytes, a stranger's own first line would choose the codec, and some take hours
        text = path.read_bytes().decode("utf-8-sig")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the parser shows a stranger's lines with its own
            return ast.parse(text)
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
        return None


def _constructs(file: str, tree: ast.Module | None) -> Iterator[Finding]:
    if tree is None:
        return
    for node in ast.walk(tree):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            for name in _names(node):
                if check := _MODULES.get(name):
                    yield Finding(check, f"imports {name}", file=file, line=node.lineno)
        elif isinstance(node, ast.Call) and isinstance(node.func, (ast.Name, ast.Attribute)):
            called = _dotted(node.func)
            if check := _CALLS.get(called):
                yield Finding(check, f"calls {called}", file=file, line=node.lineno)


def _dotted(node: ast.expr) -> str:
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        return f"{node.value.id}.{node.attr}"
    return ""


# --- imports -----------------------------------------------------------------------------------


def imports(snapshot: Snapshot) -> list[Import]:
    """What the entry file imports, and the repository's own modules that it leads to.

    What is imported within ``try`` may be missing, and what nobody imports is not needed.
    """
    files = {record.path for record in snapshot.files}
    waiting, seen, found = [snapshot.path], {snapshot.path}, []
    while waiting:
        file = waiting.pop()
        tree = parsed(snapshot.root / file)
        for node in [] if tree is None else _unguarded(tree):
            for name, own in _targets(node, file, files):
                if own and own not in seen:
                    seen.add(own)
                    waiting.append(own)
                elif not own and name and name not in sys.stdlib_module_names:
                    found.append(Import(name, file, node.lineno))
    return sorted(set(found), key=lambda one: (one.file, one.line, one.name))


def _unguarded(tree: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    waiting = [tree]  # no recursion: a stranger chose how deep it is
    while waiting:
        for node in ast.iter_child_nodes(waiting.pop()):
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                yield node
            elif not isinstance(node, ast.Try) and not _is_for_types(node):
                waiting.append(node)


def _is_for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and _dotted(node.test).endswith("TYPE_CHECKING")


def _names(node: ast.Import | ast.ImportFrom) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name.partition(".")[0] for alias in node.names]
    return [] if node.level else [(node.module or "").partition(".")[0]]


def _targets(
    node: ast.Import | ast.ImportFrom, file: str, files: set[str]
) -> Iterator[tuple[str, str]]:
    """Each module that is named: its first name, and the repository's own file if it is one."""
    folder = file.rpartition("/")[0]
    if isinstance(node, ast.Import):
        dotted = [alias.name for alias in node.names]
    else:
        for _ in range(node.level - 1):
            folder = folder.rpartition("/")[0]
        module = (node.module or "")[:_LONGEST_NAME]
        names = [alias.name[:_LONGEST_NAME] for alias in node.names]
        dotted = [module, *dict.fromkeys(f"{module}.{name}".strip(".") for name in names)]
    for number, name in enumerate(dotted):
        own = _own(name, folder, files)
        foreign = not getattr(node, "level", 0) and (isinstance(node, ast.Import) or number == 0)
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
