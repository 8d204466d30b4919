"""Parses a stranger's Python in a process that may die of it.

``parsing.py`` runs this file by its path, alone in a fresh interpreter; the file imports only the
standard library. Stdin holds each file after its length (four bytes, big endian). Stdout gets one
line of JSON for each file, in the same order: its imports, uses and names; or its encoding, if that
is not UTF-8; an empty object if it is not Python; or ``null`` if it costs too much. Names are
followed to the file's own imports and assignments, and no further.
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
"""Bytes: Python's parser takes a thousand bytes for each byte of a hostile text."""
CPU_S = 20.0
"""Seconds for one file; 256 KiB that a person wrote take less than one second."""
OUTPUT = 64 << 20
MOST = 10_000
"""Rows of each kind for one file; the answer says if there are more."""
LONGEST = 1024
"""Characters of a module's name: as many as a file's path may have."""
_LONGEST_TEXT = 200
_READ_AS = ("utf-8", "utf-8-sig", "ascii")
_DEEPEST = 8
_OUTSIDE = re.compile(
    r"~/.*|/(etc|home|proc|root|sys|boot|run|var)(/.*)?|(.*/)?\.(ssh|aws|netrc|kube|gnupg)(/.*)?"
    r"|(HF|HUGGING|GITHUB|GH|GITLAB|AWS|AZURE|GOOGLE|OPENAI|ANTHROPIC|WANDB)[A-Z_]*"
    r"_(TOKEN|SECRET|PASSWORD|KEY)[A-Z_]*"
)
DRAWN = " drawn"
"""Follows an id that the file makes with a ``render_mode``."""
_ID = re.compile(r"[A-Za-z0-9_./-]{1,80}-v\d{1,3}")
_ENTRY_POINT = re.compile(r"([A-Za-z_][\w.]*):([A-Za-z_]\w*)")
_MISSING = {"BaseException", "Exception", "ImportError", "ModuleNotFoundError"}
_BUILTINS = {"eval", "exec", "compile", "__import__", "builtins", "__loader__"}
_BY_TEXT = {"getattr", "getattr_static", "__getattribute__"}
_IMPORTERS = {"__import__", "import_module", "resolve_name", "locate"}
_SAVING = {"save", "savez", "savez_compressed", "write_array"}
_MOST_MEANINGS = 16
"""Meanings of one expression."""
_ROUNDS = 4
"""The least number of chained assignments that are followed."""
_WORDLESS = re.compile(r"(?<![A-Za-z0-9+/=_\\-])[A-Za-z0-9+/=_\\-]{1000,}")


def bound() -> None:
    """Limit this process: the kernel ends it, or refuses it memory, where the platform has limits.

    Elsewhere the size of a file bounds the memory: some 256 MiB for the largest file that is
    accepted.
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
                    raise  # macOS refuses a memory limit below the mapped memory
        signal.signal(signal.SIGPROF, signal.SIG_DFL)


def described(data: bytes) -> dict[str, Any] | None:
    """Returns a file's content; {} if this Python cannot parse it, None if it costs too much."""
    named = encoding(data)
    if named not in _READ_AS:
        return {"encoding": named[:_LONGEST_TEXT]}
    try:
        # the bytes, as ``import`` does: the decoded text may be another program
        tree = ast.parse(data)
        rows = _rows(tree)
        whole = all(len(found) <= MOST for found in rows.values())
        return {"is_whole": whole, **{kind: found[:MOST] for kind, found in rows.items()}}
    except (RecursionError, MemoryError):
        return None
    except (SyntaxError, ValueError):
        return {}


def encoding(data: bytes) -> str:
    """Returns the encoding by which Python reads a file; empty if there is no such encoding.

    A stranger's first lines must not choose a codec that decodes here: some take hours, and some
    turn a comment into code. Before Python looks for the encoding, it ends lines at carriage
    returns too, unlike ``tokenize``.
    """
    lines = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    try:
        named = codecs.lookup(tokenize.detect_encoding(io.BytesIO(lines).readline)[0]).name
        if named in _READ_AS:
            data.decode("utf-8")  # Python ignores the other bytes of a comment
    except (SyntaxError, UnicodeDecodeError):
        return ""
    return named


def _rows(tree: ast.Module) -> dict[str, list[Any]]:
    required = {id(node) for node in _required(tree)}
    within = _places(tree)
    nodes = list(ast.walk(tree))
    meanings = _Meanings(nodes)
    uses = {(name, line): None for node in nodes for name, line in meanings.used(node)}
    rows: dict[str, list[Any]] = {kind: [] for kind in ("imports", "texts", "entries", "ids")}
    rows["uses"] = [[name[-LONGEST:], line] for name, line in uses]  # its end identifies a name
    for node in nodes:
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            rows["imports"].append(
                [*_import(node), id(node) in required, node.lineno, within.get(id(node), "")]
            )
        elif isinstance(node, ast.Call):
            for module, names in _imported_by_name(meanings.of(node.func), node):
                function = within.get(id(node), "")
                rows["imports"].append(
                    [*(0, module, names, id(node) in required, node.lineno), function]
                )
            rows["ids"] += [[f"{text}{DRAWN}", node.lineno] for text in _drawn(node)]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            rows["texts"] += _text(node)
            if _ID.fullmatch(node.value):
                rows["ids"].append([node.value, node.lineno])
    rows["entries"] += [
        [ast.unparse(node.args)[:LONGEST], node.lineno]
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and node.name == "make_env"
    ]
    rows["definitions"] = _definitions(tree)
    return rows


def _definition_of(statement: ast.stmt) -> str:
    """Returns the name of a top-level function or class; decorated ones count as used."""
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    if isinstance(statement, kinds) and not statement.decorator_list:
        return statement.name[:_LONGEST_TEXT]
    return ""


def _places(tree: ast.Module) -> dict[int, str]:
    """Returns the top-level function or class around each node."""
    return {
        id(node): name
        for statement in tree.body
        if (name := _definition_of(statement))
        for node in ast.walk(statement)
    }


def _definitions(tree: ast.Module) -> list[list[Any]]:
    """Lists top-level functions and classes and the names they use; "" stands for other code."""
    definitions: dict[str, dict[str, None]] = {"": {}}
    left = MOST
    for statement in tree.body:
        if _is_program(statement):
            continue
        names = definitions.setdefault(_definition_of(statement), {})
        for node in ast.walk(statement):
            name = getattr(node, "id", "") or getattr(node, "attr", "")
            if isinstance(node, (ast.Name, ast.Attribute)) and left and name not in names:
                names[name[:_LONGEST_TEXT]] = None
                left -= 1
    return [[name, list(names)] for name, names in definitions.items()]


def _imported_by_name(called: list[str], node: ast.Call) -> Iterator[tuple[str, list[str]]]:
    """Yields the modules of ``import_module("a.b")`` and of ``register(entry_point="a.b:C")``."""
    if "importlib.import_module" in called:
        if (module := _constant(node.args[:1])) and not module.startswith("."):
            yield module[:LONGEST], []
        return
    for keyword in node.keywords:
        value = keyword.value.value if isinstance(keyword.value, ast.Constant) else None
        text = value[:LONGEST] if isinstance(value, str) else ""
        if keyword.arg == "entry_point" and (match := _ENTRY_POINT.fullmatch(text)):
            yield match[1], [match[2]]


def _drawn(node: ast.Call) -> Iterator[str]:
    """Yields the ids in a call that has a ``render_mode``."""
    arguments = {keyword.arg: keyword.value for keyword in node.keywords}
    mode = arguments.get("render_mode")
    if mode is None or (isinstance(mode, ast.Constant) and mode.value is None):
        return
    for value in (*node.args, *filter(None, [arguments.get("id")])):
        text = _constant([value])
        if text and _ID.fullmatch(text):
            yield text


class _Meanings:
    """The possible meanings of a file's expressions, by its imports and assignments.

    A name may have several meanings, since scopes are ignored. A name in a text, as in
    ``getattr(os, "system")`` or ``vars(os)["system"]``, counts like a written name.
    """

    def __init__(self, nodes: list[ast.AST]) -> None:
        self._imported: dict[str, list[str]] = {}
        self._assigned: dict[str, list[str]] = {}
        self._stars: list[str] = []
        self._free = _BUILTINS - {_bound_by(node) for node in nodes}
        self._roots = {*self._free, *_BY_TEXT, "vars"}
        for node in nodes:
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                self._import(node)
        pairs = [pair for node in nodes for pair in _assignments(node)]
        for _ in range(_ROUNDS):
            if not sum([self._assign(target, self.of(value)) for target, value in pairs]):
                break

    def _import(self, node: ast.Import | ast.ImportFrom) -> None:
        for alias, name in zip(node.names, _imported(node), strict=False):
            self._roots.add(name.partition(".")[0])
            if alias.name == "*":
                _add(self._stars, [name[:-2]])
            elif alias.asname or isinstance(node, ast.ImportFrom):
                _add(self._imported.setdefault(alias.asname or alias.name, []), [name])
            else:
                first = name.partition(".")[0]
                _add(self._imported.setdefault(first, []), [first])

    def _assign(self, target: ast.AST, meanings: list[str]) -> bool:
        known = [meaning for meaning in meanings if re.split(r"[.:]", meaning)[0] in self._roots]
        known = [meaning for meaning in known if not meaning.endswith("()")]
        name = _bound_by(target) or getattr(target, "attr", "")
        return bool(known and name) and _add(self._assigned.setdefault(name, []), known)

    def used(self, node: ast.AST) -> list[tuple[str, int]]:
        """Returns the dotted names or the builtin that a node uses, with its line."""
        line = getattr(node, "lineno", 0)
        return [(name, line) for name in self._used(node)]

    def _used(self, node: ast.AST) -> list[str]:
        if isinstance(node, ast.ImportFrom):
            return _imported(node)
        if isinstance(node, ast.Call):
            called = self.of(node.func)
            builtins = [name for name in called if name in _BUILTINS]
            return [*builtins, *_arguments(called, node), *filter(_is_dotted, self.of(node))]
        if isinstance(node, ast.Name):
            return [
                meaning for meaning in self.of(node) if _is_dotted(meaning) or meaning in self._free
            ]
        if isinstance(node, (ast.Attribute, ast.Subscript)):
            return list(filter(_is_dotted, self.of(node)))
        return []

    def of(self, node: ast.AST | None, left: int = _DEEPEST) -> list[str]:
        """Returns an expression's meanings; a container has those of its members."""
        dotted: list[str] = []
        if not left or node is None:
            return ["()"]
        if isinstance(node, ast.Name):
            dotted = self._named(node.id)
        elif isinstance(node, ast.Attribute):
            name = node.attr[:_LONGEST_TEXT]
            dotted = [f"{base}.{name}" for base in self.of(node.value, left - 1)]
            dotted += self._assigned.get(node.attr, [])
        elif isinstance(node, ast.Call):
            for function in self.of(node.func, left - 1):
                _add(dotted, self._called(function, node, left - 1))
        elif isinstance(node, ast.Subscript):
            for base in self.of(node.value, left - 1):
                _add(dotted, self._item(base, _constant([node.slice])))
        elif isinstance(node, (ast.Constant, ast.Lambda)):
            dotted = ["()"]
        else:
            for child in ast.iter_child_nodes(node):
                if isinstance(child, ast.expr) and len(dotted) < _MOST_MEANINGS:
                    _add(
                        dotted, [meaning for meaning in self.of(child, left - 1) if meaning != "()"]
                    )
        return dotted[:_MOST_MEANINGS] or ["()"]

    def _named(self, name: str) -> list[str]:
        if name == "__builtins__":
            return ["builtins"]
        usual = [name[:_LONGEST_TEXT], *(f"{module}.{name}" for module in self._stars)]
        return self._imported.get(name, usual) + self._assigned.get(name, [])

    def _called(self, function: str, node: ast.Call, left: int) -> list[str]:
        owner, _, name = function.rpartition(".")
        owners, arguments = [owner], node.args
        if name in _BY_TEXT and len(arguments) > 1:
            owners, arguments = self.of(arguments[0], left), arguments[1:]
        text = _constant(arguments[:1])
        if name in _BY_TEXT and arguments:
            computed = "[computed]" if not isinstance(arguments[0], ast.Constant) else "()"
            return [f"{owner}.{text or computed}" for owner in owners]
        if name in _IMPORTERS and text:
            self._roots.add(re.split("[.:]", text)[0])
            return [text.replace(":", ".")]
        if name in ("attrgetter", "methodcaller") and text:
            return [f"operator:{text}"]
        if function.startswith("operator:") and arguments:
            return [f"{owner}.{function[9:]}" for owner in self.of(arguments[0], left)]
        if name in ("vars", "getmembers") and arguments:
            return [f"{owner}.__dict__" for owner in self.of(arguments[0], left)]
        return self._item(owner, text) if name in ("get", "pop") and text else [f"{function}()"]

    def _item(self, base: str, key: str) -> list[str]:
        """Returns a key's value in a namespace, by its name; else the container itself."""
        if base in ("globals()", "locals()", "vars()") and key:
            return self._named(key)
        if base == "sys.modules" and key:
            return [f"{base}.{key}"]
        if base == "builtins" or base.endswith(".__dict__"):
            return [f"{base.removesuffix('.__dict__')}.{key or '[computed]'}"]
        return [base]


def _imported(node: ast.Import | ast.ImportFrom) -> list[str]:
    """Returns the dotted names that a statement imports, except the repository's own."""
    names = [alias.name[:_LONGEST_TEXT] for alias in node.names]
    if isinstance(node, ast.Import):
        return names
    module = (node.module or "")[:_LONGEST_TEXT]
    return [] if node.level else [f"{module}.{name}" for name in names]


def _add(meanings: list[str], further: list[str]) -> bool:
    """Adds further meanings; tells whether one of them is new and there is room for more."""
    new = [meaning for meaning in dict.fromkeys(further) if meaning not in meanings]
    meanings += new[: max(_MOST_MEANINGS - len(meanings), 0)]
    return bool(new) and len(meanings) < _MOST_MEANINGS


def _is_dotted(name: str) -> bool:
    return "." in name and not name.endswith("()")


def _constant(nodes: list[ast.expr]) -> str:
    """Returns the value of a single literal text; else an empty text."""
    value = nodes[0].value if nodes and isinstance(nodes[0], ast.Constant) else None
    return value[:_LONGEST_TEXT] if isinstance(value, str) else ""


def _bound_by(node: ast.AST) -> str:
    """Returns the name that a node binds to a value of the file's own."""
    if isinstance(node, ast.Name):
        return "" if isinstance(node.ctx, ast.Load) else node.id
    if isinstance(node, (ast.arg, ast.keyword)):
        return node.arg or ""
    return node.name if isinstance(node, (ast.FunctionDef, ast.ClassDef)) else ""


def _assignments(node: ast.AST) -> Iterator[tuple[ast.AST, ast.expr]]:
    """Yields each target with its value; a loop's target is a member of its value."""
    if isinstance(node, ast.Assign):
        for target in node.targets:
            yield from _unpacked(target, node.value)
    elif isinstance(node, (ast.For, ast.AsyncFor, ast.comprehension)):
        yield from _unpacked(node.target, node.iter)
    elif isinstance(node, (ast.AnnAssign, ast.NamedExpr, ast.AugAssign)) and node.value:
        yield from _unpacked(node.target, node.value)
    elif isinstance(node, ast.withitem) and node.optional_vars:
        yield from _unpacked(node.optional_vars, node.context_expr)
    elif isinstance(node, ast.keyword):
        yield node, node.value
    elif isinstance(node, ast.arguments):
        usual = [*node.posonlyargs, *node.args]
        yield from zip(reversed(usual), reversed(node.defaults), strict=False)
        pairs = zip(node.kwonlyargs, node.kw_defaults, strict=True)
        yield from ((target, value) for target, value in pairs if value)


def _unpacked(target: ast.expr, value: ast.expr) -> Iterator[tuple[ast.AST, ast.expr]]:
    if isinstance(target, (ast.Tuple, ast.List)):
        values = value.elts if isinstance(value, (ast.Tuple, ast.List)) else []
        if len(values) != len(target.elts):
            values = [value] * len(target.elts)
        for part, its in zip(target.elts, values, strict=True):
            yield from _unpacked(part, its)
    elif isinstance(target, (ast.Subscript, ast.Starred)):
        yield from _unpacked(target.value, value)
    else:
        yield target, value


def _arguments(called: list[str], node: ast.Call) -> Iterator[str]:
    """Yields the reasons why a call loads pickles: an argument, or the lack of an argument."""
    arguments = {keyword.arg: keyword.value for keyword in node.keywords}
    if isinstance(several := arguments.pop(None, None), ast.Dict):
        keys = [_constant([key]) if key else "" for key in several.keys]
        arguments |= zip(keys, several.values, strict=True)
    if "numpy.load" in called and len(node.args) > 2:
        arguments["allow_pickle"] = node.args[2]
    names = {name.rpartition(".")[2] for name in called}
    if _may_be(arguments.get("allow_pickle", ast.Constant(None))) and names.isdisjoint(_SAVING):
        yield "allow_pickle=True"
    if (
        {"yaml.load", "yaml.load_all"} & {*called}
        and "Loader" not in arguments
        and len(node.args) < 2
    ):
        yield "yaml.load without a Loader"


def _may_be(node: ast.expr) -> bool:
    """Tells whether a value may be true."""
    return not isinstance(node, ast.Constant) or bool(node.value)


def _text(node: ast.Constant) -> list[list[Any]]:
    """Returns a row for a text that names a place outside, or that no person can read."""
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
    """Yields every node except those of optional imports and of imports for other programs."""
    waiting = [tree]  # no recursion: a stranger chose the depth
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
    """Tells whether a handler catches the error of a missing module."""
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
        and any(_last(argument) in _MISSING for argument in node.args)
    )


def _asks(node: ast.If) -> bool:
    """Tells whether a test calls ``find_spec``: ``if importlib.util.find_spec("a"):``"""
    return any(
        isinstance(child, ast.expr) and _last(child) == "find_spec" for child in ast.walk(node.test)
    )


def _last(node: ast.expr) -> str:
    return _dotted(node).rpartition(".")[2]


def _is_program(node: ast.AST) -> bool:
    """Tells whether a statement is ``if __name__ == "__main__":``"""
    test = node.test if isinstance(node, ast.If) else None
    return isinstance(test, ast.Compare) and _dotted(test.left) == "__name__"


def _dotted(node: ast.expr) -> str:
    """Returns ``a.b.c`` as a text; empty for other expressions and for very long chains."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute) and len(parts) < _DEEPEST:
        parts.append(node.attr)
        node = node.value
    return ".".join([node.id, *reversed(parts)]) if isinstance(node, ast.Name) else ""


def main() -> None:
    """Answer for each file; a file that exceeds its limits ends this process."""
    bound()
    warnings.simplefilter("ignore")  # a warning of the parser's would show a stranger's lines
    while head := sys.stdin.buffer.read(4):
        data = sys.stdin.buffer.read(int.from_bytes(head, "big"))
        # limit the CPU time of the next file, or the clock's where CPU time is not counted
        if sys.platform == "win32":
            faulthandler.dump_traceback_later(CPU_S, exit=True)  # its thread needs no other thread
        else:
            signal.setitimer(signal.ITIMER_PROF, CPU_S)
        line = json.dumps(described(data))
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
