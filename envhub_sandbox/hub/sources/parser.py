"""Parses a stranger's Python in a process that may be lost over it.

``parsing.py`` runs this file by its path, alone in a fresh interpreter: it imports the standard
library and nothing else. Stdin has each file behind its length (four bytes, big endian), stdout
gets one line of JSON for each, in the same order: what it imports, calls, uses and names, or its
encoding where that is another than UTF-8, nothing of what is no Python, ``null`` of what was too
much. Names are followed to what they were
imported as in that file, and no further.
"""

from __future__ import annotations

import ast
import codecs
import faulthandler
import io
import json
import re
import signal
import sys
import tokenize
import warnings
from collections.abc import Iterator
from typing import Any

if sys.platform != "win32":
    import resource

MEMORY = 1 << 30
"""Bytes: Python's parser takes a thousand for each of a hostile text."""
CPU_S = 20.0
"""For one file; 256 KiB that a person wrote take less than one."""
OUTPUT = 64 << 20
MOST = 10_000
"""Of each kind, for one file."""
LONGEST = 1024
"""Of a module, as a path of a file can be."""
_LONGEST_TEXT = 200
_READ_AS = ("utf-8", "utf-8-sig", "ascii")
_DEEPEST = 8
_OUTSIDE = re.compile(
    r"~/.*|/(etc|home|proc|root|sys|boot|run|var)(/.*)?|(.*/)?\.(ssh|aws|netrc|kube|gnupg)(/.*)?"
    r"|(HF|HUGGING|GITHUB|GH|GITLAB|AWS|AZURE|GOOGLE|OPENAI|ANTHROPIC|WANDB)[A-Z_]*"
    r"_(TOKEN|SECRET|PASSWORD|KEY)[A-Z_]*"
)
_ID = re.compile(r"[A-Za-z0-9_./-]{1,80}-v\d{1,3}")
_ENTRY_POINT = re.compile(r"([A-Za-z_][\w.]*):([A-Za-z_]\w*)")
_MISSING = {"BaseException", "Exception", "ImportError", "ModuleNotFoundError"}
_WORDLESS = re.compile(r"(?<![A-Za-z0-9+/=_\\-])[A-Za-z0-9+/=_\\-]{1000,}")


def bound() -> None:
    """From here on the kernel ends us, or refuses us memory: as far as there are limits.

    Where there are none, a file's size bounds what it takes: some 256 MiB for the largest that is
    read.
    """
    if sys.platform != "win32":
        for what, most in (
            (resource.RLIMIT_AS, MEMORY),
            (resource.RLIMIT_FSIZE, OUTPUT),
            (resource.RLIMIT_CORE, 0),
            (resource.RLIMIT_NOFILE, 8),
        ):
            hard = resource.getrlimit(what)[1]
            least = most if hard == resource.RLIM_INFINITY else min(most, hard)
            try:
                resource.setrlimit(what, (least, least))
            except (OSError, ValueError):
                if sys.platform == "linux":
                    raise  # macOS takes no limit of memory below what a process has mapped
        signal.signal(signal.SIGPROF, signal.SIG_DFL)


def begin_file() -> None:
    """From here on one file has its share of time: of the processor's, or where that is not
    counted of the clock's.
    """
    if sys.platform == "win32":
        faulthandler.dump_traceback_later(CPU_S, exit=True)  # a thread that waits for no other
    else:
        signal.setitimer(signal.ITIMER_PROF, CPU_S)


def described(data: bytes) -> dict[str, Any] | None:
    """What a file says; nothing of what is no Python of this version, None of what is too much."""
    named = encoding(data)
    if named not in _READ_AS:
        return {"encoding": named[:_LONGEST_TEXT]}
    try:
        # the bytes: what ``import`` compiles; a decoded text can be another program
        tree = ast.parse(data)
        return {kind: rows[:MOST] for kind, rows in _rows(tree).items()}
    except (RecursionError, MemoryError):
        return None
    except (SyntaxError, ValueError):
        return {}


def encoding(data: bytes) -> str:
    """The encoding by which Python reads a file; empty where it has none that there is.

    Nothing is decoded by a codec that a stranger's first lines choose: some take hours, and some
    make code of a comment. Python ends lines at a carriage return, too, before it looks for the
    encoding, and ``tokenize`` does not.
    """
    lines = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    try:
        named = codecs.lookup(tokenize.detect_encoding(io.BytesIO(lines).readline)[0]).name
        if named in _READ_AS:
            data.decode("utf-8")  # Python does not mind what else a comment holds
    except (SyntaxError, UnicodeDecodeError):
        return ""
    return named


def _rows(tree: ast.Module) -> dict[str, list[Any]]:
    required = {id(node) for node in _required(tree)}
    within = _places(tree)
    aliases = _aliases(tree)
    found: dict[str, list[Any]] = {
        kind: [] for kind in ("imports", "calls", "uses", "fetches", "texts", "entries", "ids")
    }
    for node in ast.walk(tree):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            found["imports"].append(
                [*_import(node), id(node) in required, node.lineno, within.get(id(node), "")]
            )
        elif isinstance(node, ast.Call) and (name := _meant(node.func, aliases)):
            found["calls"].append([name, node.lineno])
            found["fetches"] += _fetched(name, node, aliases)
            for module, names in _imported_by_name(name, node):
                place = within.get(id(node), "")
                found["imports"].append(
                    [*(0, module, names, id(node) in required, node.lineno), place]
                )
        elif isinstance(node, (ast.Name, ast.Attribute)):
            if (name := _meant(node, aliases)) and "." in name:
                found["uses"].append([name, node.lineno])
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found["texts"] += _text(node)
            if _ID.fullmatch(node.value):
                found["ids"].append([node.value, node.lineno])
    found["entries"] += [
        [ast.unparse(node.args)[:LONGEST], node.lineno]
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and node.name == "make_env"
    ]
    found["definitions"] = _definitions(tree)
    return found


def _definition_of(statement: ast.stmt) -> str:
    """The name of a function or class at the top of a file; decorated ones are used at once."""
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    if isinstance(statement, kinds) and not statement.decorator_list:
        return statement.name[:_LONGEST_TEXT]
    return ""


def _places(tree: ast.Module) -> dict[int, str]:
    """The function or class at the top of the file that a node lies in."""
    return {
        id(node): name
        for statement in tree.body
        if (name := _definition_of(statement))
        for node in ast.walk(statement)
    }


def _definitions(tree: ast.Module) -> list[list[Any]]:
    """Each function and class at the top with the names that it uses; without a name: the rest."""
    found: dict[str, dict[str, None]] = {"": {}}
    left = MOST
    for statement in tree.body:
        if _is_program(statement):
            continue
        names = found.setdefault(_definition_of(statement), {})
        for node in ast.walk(statement):
            name = getattr(node, "id", "") or getattr(node, "attr", "")
            if isinstance(node, (ast.Name, ast.Attribute)) and left and name not in names:
                names[name[:_LONGEST_TEXT]] = None
                left -= 1
    return [[name, list(names)] for name, names in found.items()]


def _imported_by_name(called: str, node: ast.Call) -> Iterator[tuple[str, list[str]]]:
    """``import_module("a.b")``, and ``register(..., entry_point="a.b:C")``."""
    first = node.args[0] if node.args else None
    if called == "importlib.import_module" and isinstance(first, ast.Constant):
        if isinstance(first.value, str) and not first.value.startswith("."):
            yield first.value[:LONGEST], []
        return
    for keyword in node.keywords:
        value = keyword.value.value if isinstance(keyword.value, ast.Constant) else None
        text = value[:LONGEST] if isinstance(value, str) else ""
        if keyword.arg == "entry_point" and (found := _ENTRY_POINT.fullmatch(text)):
            yield found[1], [found[2]]


def _aliases(tree: ast.Module) -> dict[str, str]:
    """What names mean that were imported anywhere in a file: ``{"np": "numpy"}``."""
    found = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.asname:
                    found[alias.asname] = alias.name[:_LONGEST_TEXT]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            for alias in node.names:
                whole = f"{(node.module or '')[:_LONGEST_TEXT]}.{alias.name[:_LONGEST_TEXT]}"
                found[alias.asname or alias.name] = whole
    return found


def _meant(node: ast.expr, aliases: dict[str, str]) -> str:
    first, dot, rest = _dotted(node).partition(".")
    return f"{aliases.get(first, first)}{dot}{rest}"[:LONGEST]


def _fetched(called: str, node: ast.Call, aliases: dict[str, str]) -> list[list[Any]]:
    """``getattr(module, name)``: the name is null where it is computed."""
    if called == "numpy.load":
        pickles = [one for one in node.keywords if one.arg == "allow_pickle" and _may_be(one.value)]
        return [["numpy.load", "allow_pickle", node.lineno] for _ in pickles[:1]]
    if called != "getattr" or len(node.args) < 2:
        return []
    name = node.args[1]
    text = name.value if isinstance(name, ast.Constant) and isinstance(name.value, str) else None
    if isinstance(name, ast.Constant) and text is None:
        return []
    return [[_meant(node.args[0], aliases), text and text[:_LONGEST_TEXT], node.lineno]]


def _may_be(node: ast.expr) -> bool:
    """Whether a value may be true."""
    return not isinstance(node, ast.Constant) or bool(node.value)


def _text(node: ast.Constant) -> list[list[Any]]:
    """Of texts that name places beyond the repository, or that no person can read."""
    text = str(node.value)
    if len(text) <= _LONGEST_TEXT and _OUTSIDE.fullmatch(text):
        return [["outside", text, len(text), node.lineno]]
    return [["wordless", "", len(text), node.lineno]] if _WORDLESS.search(text) else []


def _import(node: ast.Import | ast.ImportFrom) -> list[Any]:
    names = list(dict.fromkeys(alias.name[:LONGEST] for alias in node.names))[:MOST]
    if isinstance(node, ast.Import):
        return [-1, "", names]
    return [node.level, (node.module or "")[:LONGEST], names]


def _required(tree: ast.AST) -> Iterator[ast.AST]:
    """Every node but those of imports that may fail, or are for other programs."""
    waiting = [tree]  # no recursion: a stranger chose how deep it is
    while waiting:
        node = waiting.pop()
        yield node
        waiting += _needed_below(node)


def _needed_below(node: ast.AST) -> list[ast.AST]:
    for_types = isinstance(node, ast.If) and _last(node.test) == "TYPE_CHECKING"
    if isinstance(node, ast.If) and (for_types or _is_program(node) or _asks(node)):
        return [*node.orelse]
    if isinstance(node, ast.With) and any(_suppresses(item.context_expr) for item in node.items):
        return []
    if isinstance(node, ast.Try) and (catching := list(filter(_catches, node.handlers))):
        forgives = not all(_gives_up(handler) for handler in catching)
        return [*(() if forgives else node.body), *node.orelse, *node.finalbody]
    return list(ast.iter_child_nodes(node))


def _catches(handler: ast.ExceptHandler) -> bool:
    """Whether it is where a missing module leads to."""
    kinds = handler.type.elts if isinstance(handler.type, ast.Tuple) else [handler.type]
    return any(kind is None or _last(kind) in _MISSING for kind in kinds)


def _gives_up(handler: ast.ExceptHandler) -> bool:
    end = handler.body[-1]
    called = end.value if isinstance(end, ast.Expr) else None
    leaves = isinstance(called, ast.Call) and _last(called.func) == "exit"
    return isinstance(end, ast.Raise) or leaves


def _suppresses(node: ast.expr) -> bool:
    return (
        isinstance(node, ast.Call)
        and _last(node.func) == "suppress"
        and any(_last(one) in _MISSING for one in node.args)
    )


def _asks(node: ast.If) -> bool:
    """``if importlib.util.find_spec("a"):``"""
    return any(
        isinstance(one, ast.expr) and _last(one) == "find_spec" for one in ast.walk(node.test)
    )


def _last(node: ast.expr) -> str:
    return _dotted(node).rpartition(".")[2]


def _is_program(node: ast.AST) -> bool:
    """``if __name__ == "__main__":``"""
    test = node.test if isinstance(node, ast.If) else None
    return isinstance(test, ast.Compare) and _dotted(test.left) == "__name__"


def _dotted(node: ast.expr) -> str:
    """``a.b.c`` as a text; empty for what is no chain of names, or a very long one."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute) and len(parts) < _DEEPEST:
        parts.append(node.attr)
        node = node.value
    return ".".join([node.id, *reversed(parts)]) if isinstance(node, ast.Name) else ""


def main() -> None:
    """Answer for each file; what a file costs beyond its share ends us."""
    bound()
    warnings.simplefilter("ignore")  # the parser shows a stranger's lines with its own
    while head := sys.stdin.buffer.read(4):
        data = sys.stdin.buffer.read(int.from_bytes(head, "big"))
        begin_file()
        line = json.dumps(described(data))
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
