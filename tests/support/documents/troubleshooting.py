"""``docs/troubleshooting.md``, written from the messages of the code that name a cure.

A message is a text in the source of either package; it names a cure where a sentence of it, or a
part behind a colon or a semicolon, tells somebody to do something. What varies in a message is an
ellipsis on the page. Write it again with ``python -m tests.support.documents.troubleshooting``.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import envhub_sandbox
import envhub_worker
from envhub_sandbox.settings.options import option_name
from tests.support.documents.written import DOCS, filled

DOCUMENT = DOCS / "troubleshooting.md"
# title, where it is said, what more there is about it
_PARTS = (
    (
        "References, the Hub and local folders",
        ("envhub_sandbox/hub", "envhub_sandbox/system/folders.py"),
        "snapshots.md",
    ),
    ("A repository's packages", ("envhub_sandbox/dependencies",), "dependencies.md"),
    ("Locks", ("envhub_sandbox/dependencies/locks",), "dependencies.md#locks"),
    (
        "Arguments, policies, limits, timeouts",
        ("envhub_sandbox/factory", "envhub_sandbox/settings"),
        "settings.md",
    ),
    ("What this host can enforce", ("envhub_worker/lockdown",), "threat-model.md"),
    (
        "Containers",
        ("envhub_sandbox/sandboxes/docker",),
        "deployment.md#containers-on-this-machine",
    ),
    (
        "Servers on other hosts",
        (
            "envhub_sandbox/sandboxes/remote.py",
            "envhub_sandbox/sandboxes/remote_keys.py",
            "envhub_sandbox/sandboxes/remote_repository.py",
            "envhub_sandbox/transport/tcp.py",
            "envhub_sandbox/transport/connection.py",
            "envhub_worker/access",
            "envhub_worker/cli",
        ),
        "deployment.md#servers-on-other-hosts",
    ),
    ("A Ray cluster", ("envhub_sandbox/sandboxes/ray",), "ray.md"),
    (
        "Environments in use",
        (
            *("envhub_sandbox/session", "envhub_sandbox/vector", "envhub_sandbox/transport"),
            "envhub_sandbox/system/platform.py",
        ),
        "faults.md",
    ),
    (
        "Loading a repository, and what it returns",
        ("envhub_worker/runner", "envhub_worker/file_access"),
        "authors.md",
    ),
    ("Values", ("envhub_worker/protocol",), "values.md"),
    (
        "The command line",
        ("envhub_sandbox/cli", "envhub_sandbox/check", "envhub_sandbox/session/crash"),
        "cli.md",
    ),
    ("Other libraries", ("envhub_sandbox/integrations",), "integrations.md"),
    ("The rest", ("envhub_sandbox", "envhub_worker"), "architecture.md"),
)

# What a cure begins with: an order, what a setting takes, which ones there are, or a command.
_ORDERS = re.findall(
    r"\w+",
    """
    accept add ask build call change check choose close create declare delete do download drive
    drop end fetch free give hand hold install keep kill leave lock log look lower make mount
    move name offer pass permit pin put raise read remove rename resolve return run say see set
    start stop take try unset update upgrade use verify wait write
    """,
)
_BEFORE = r"(?:^|(?<=[.;:?] )|(?<=[;,] or )|(?<=\n)|(?<=, )(?=add|set|try))"
_UNLESS = r"(?:[Ii]f [^.;:,]*[,:;] |To [^.;:,]*, |then |or )?"
_CURE = re.compile(
    rf"{_BEFORE}{_UNLESS}"
    rf"(?:(?:{'|'.join(f'[{one[0]}{one[0].upper()}]{one[1:]}' for one in _ORDERS)})(?![\w-]|=)"
    r"|(?:it|--\w+) takes |it is (?:one of |True or False|'[a-z]+',)"
    r"|there are:? (?:\(suite/task\): )?…|it has …|reset\(\) brings |['`]envhub |is 'envhub"
    r"|whoever runs it starts )"
    r"|needs a server that was started |must (?:return|expose) "
)
NO_MORE = "what the error says"
"""What stands on the right where the left names the cure."""
_GOES_ON = re.compile(r" *;|(?:and|or|which|takes|needs|free|it (?:has|needs|does|cannot)) ")
"""How a text begins that stands behind one that varies."""
# What a function or a class of this name is told is no message: help, and checks (docs/checks.md).
_NO_MESSAGES = {
    *("Option", "_option", "Argument", "Typer", "add_argument", "add_parser", "Check", "Template")
}
_NO_FILES = (
    "envhub_sandbox/check/markup.py",
    "envhub_sandbox/check/page.py",
    "envhub_sandbox/check/checks.py",
    "envhub_sandbox/check/static.py",
    "envhub_sandbox/cli/app.py",
    "envhub_sandbox/dependencies/locks/lockfile.py",
)
# Nor is this: parts of other formats, what is said after success, and answers to our own client.
_NO_ERRORS = re.compile(
    r"^(?:RUN |FROM |Connection: |make a CURVE key pair$|end a server after its open jails )"
    r"|^(?:say Hello first|check membership of)$|^\[\[|; (?:offer it|ask for them) first$"
    r"|\b(?:Use|Try) it: "
)


@dataclass(frozen=True)
class Message:
    """One text that names a cure.

    Attributes:
        place: The file, from the package on.
        says: What is wrong.
        cure: What to do.
        apart: The two are put together later, with something between them.
    """

    place: str
    says: str
    cure: str
    apart: bool = field(default=False, compare=False)

    @property
    def text(self) -> str:
        """All of it; a fragment of a message is also found as a part of the message."""
        return self.cure if self.apart else self.says + self.cure

    @property
    def fixed(self) -> list[str]:
        """What is the same each time, as it stands in the source."""
        whole = [self.says, self.cure] if self.apart else [self.says + self.cure]
        return [part for text in whole for part in re.split(r"…", text) if len(part.strip()) > 2]


def document() -> str:
    """What the file has to hold."""
    parts, found = list[str](), messages()
    texts = {one.text for one in found}
    whole = [one for one in found if not any(one.text in text != one.text for text in texts)]
    for title, _, more in _PARTS:
        rows = sorted({_row(one) for one in whole if _part(one.place) == title})
        parts += [f"## {title}\n\nMore in [{more.partition('#')[0]}]({more}).\n"]
        parts += ["| The error says | What to do |\n| --- | --- |"]
        parts += [*(f"| {says} | {cure} |" for says, cure in rows), ""]
    return filled(DOCUMENT, written="\n".join(parts))


def _part(file: str) -> str:
    """The title of what a file belongs to: that with the longest prefix of its path."""
    return max(
        (len(place), title)
        for title, places, _ in _PARTS
        for place in places
        if file.startswith(place)
    )[1]


@cache
def messages() -> list[Message]:
    """Every message of the two packages that names a cure."""
    found = []
    for package in (envhub_sandbox, envhub_worker):
        root = Path(next(iter(package.__path__)))
        for path in sorted(root.rglob("*.py")):
            place = f"{package.__name__}/{path.relative_to(root)}"
            if place not in _NO_FILES:
                found += of_source(path.read_text(), place)
    return found


def of_source(source: str, place: str) -> Iterator[Message]:
    reader, module = _Reader(), ast.parse(source)
    reader.note_functions(module)
    reader.visit(module)
    for before, text in reader.found:
        cure = _CURE.search(text)
        if cure is None or _NO_ERRORS.search(text) or len(re.findall(r"[^\W_]+", text)) < 3:
            continue
        says = text[: cure.start()]
        if says.strip(" …:;.,"):
            yield Message(place, says, text[cure.start() :])
        else:
            yield Message(place, before, text, apart=True)


class _Reader(ast.NodeVisitor):
    """Collects the texts of a module, each with the one that stands before it."""

    def __init__(self) -> None:
        self.found: list[tuple[str, str]] = []
        self._named: dict[str, str] = {}

    def note_functions(self, module: ast.Module) -> None:
        """What functions return that are one text, which others are made of."""
        for node in module.body:
            last = node.body[-1] if isinstance(node, ast.FunctionDef) else None
            if isinstance(node, ast.FunctionDef) and isinstance(last, ast.Return) and last.value:
                self._named[f"{node.name}()"] = self._text(last.value) or "…"

    def visit_Assign(self, node: ast.Assign) -> None:
        text = self._text(node.value)
        text = _option(node.value) or text
        if text is not None and isinstance(node.targets[0], ast.Name):
            self._named[node.targets[0].id] = text
        self.visit(node.value)

    def visit_Expr(self, node: ast.Expr) -> None:
        if not isinstance(node.value, ast.Constant):  # a docstring
            self.visit(node.value)

    def visit_Call(self, node: ast.Call) -> None:
        name = getattr(node.func, "attr", None) or getattr(node.func, "id", "")
        if name not in _NO_MESSAGES:
            self.visit(node.func)
            self._row([*node.args, *(keyword.value for keyword in node.keywords)])

    def visit_Tuple(self, node: ast.Tuple) -> None:
        self._row(node.elts)

    def _row(self, nodes: list[ast.expr]) -> None:
        before = ""
        for node in nodes:
            text = self._text(node)
            if text is None:
                self.visit(node)
                continue
            self.found.append((before if " " in before else "", text))
            before = text

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, str):
            self.found.append(("", self._text(node) or ""))

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        self.found.append(("", self._text(node) or ""))

    def visit_BinOp(self, node: ast.BinOp) -> None:
        text = self._text(node)
        if text is None:
            self.generic_visit(node)
        else:
            self.found.append(("", text))

    def _text(self, node: ast.expr) -> str | None:
        """A text with an ellipsis for what varies; None of what is no text."""
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            return re.sub(r"\{\w+(?:![rs])?\}|%(?:\.\d)?[sdfr]", "…", node.value)
        if isinstance(node, ast.JoinedStr):
            return "".join(self._part(part) for part in node.values)
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
            left, right = self._text(node.left), self._text(node.right)
            return None if left is right is None else f"{left or '…'}{right or '…'}"
        return None

    def _part(self, part: ast.expr) -> str:
        if isinstance(part, ast.Constant):
            # "{{url}}" is a field of a format that is filled in later
            return re.sub(r"\{\w+\}", "…", str(part.value))
        assert isinstance(part, ast.FormattedValue)
        if isinstance(part.value, ast.Name):
            return self._named.get(part.value.id, "…")
        name = getattr(getattr(part.value, "func", None), "id", "")
        return _option(part.value) or self._named.get(f"{name}()", "…")


def _option(node: ast.expr) -> str | None:
    """An option as Python has it, where its name is asked for; None of anything else."""
    if not isinstance(node, ast.Call) or getattr(node.func, "id", "") != "option_name":
        return None
    key, *value = [_literal(one) for one in node.args]
    return None if isinstance(key, _Varying) else option_name(key, *value)


class _Varying:
    """What is different each time."""

    def __repr__(self) -> str:
        return "…"


def _literal(node: ast.expr) -> Any:
    try:
        return ast.literal_eval(node)
    except ValueError:
        return _Varying()


def _row(message: Message) -> tuple[str, str]:
    """What is searched for stands on the left, also where it is nothing but a cure."""
    if message.says:
        return _cell(_begun(message.says)), _cell(message.cure)
    return _cell(_begun(message.cure)), NO_MORE


def _begun(text: str) -> str:
    """With an ellipsis in front, where a text goes on from one that varies."""
    return f"… {text.lstrip()}" if _GOES_ON.match(text) else text


def _cell(text: str) -> str:
    """A text in a table, with nothing in it that Markdown or HTML would take for its own."""
    plain = " ".join(text.split()).replace("\\", "\\\\")
    return re.sub(r"([|*_<>\[\]`])", r"\\\1", plain).replace("&", "&amp;")


if __name__ == "__main__":
    DOCUMENT.write_text(document())
