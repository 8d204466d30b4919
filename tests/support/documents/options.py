"""``docs/options.md``, written from the commands themselves.

Write it again with ``python -m tests.support.documents.options``.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import pkgutil
import re
import typing
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from enum import Enum
from typing import Any, Literal

import typer

from envhub_sandbox.cli.app import app, functions
from envhub_worker import cli
from tests.support.documents.written import DOCS, filled

DOCUMENT = DOCS / "options.md"
Row = tuple[str, str, str]
_SHARED = 2
"""How many commands have an option for it to stand with those that are shared."""
_TITLE = "Shared options"


def document() -> str:
    commands = [*_commands()]
    counted = Counter(row for *_, rows in commands for row in rows)
    often = [row for row, count in counted.items() if count >= _SHARED and row[0][:2] == "--"]
    shared = list({row[0].split(" ")[0]: row for row in reversed(often)}.values())[::-1]
    parts = [f"## {_TITLE}\n", *_table(shared)]
    for name, what, rows in commands:
        parts += _part(name, what, rows, shared)
    for name in sorted(module.name for module in pkgutil.iter_modules(cli.__path__)):
        module = importlib.import_module(f"{cli.__name__}.{name}")
        if hasattr(module, "add_arguments") and name != "serve":
            module.add_arguments(given := _Arguments())
            parts += _part(f"envhub-worker {name}", module.run.__doc__, given.rows)
    return filled(DOCUMENT, written="\n".join(parts))


def _commands() -> Iterator[tuple[str, str | None, list[Row]]]:
    """The commands of the program, and those that are below others: name, help and options."""
    for name in typer.main.get_command(app).commands:  # type: ignore[attr-defined]
        for one, function in functions(name).items():
            words = name if one == name else f"{name} {one}"
            yield f"envhub {words}", function.__doc__, list(_options(function))


def _part(
    name: str, what: str | None, rows: list[Row], shared: Collection[Row] = ()
) -> Iterator[str]:
    yield f"## `{name}`\n"
    yield f"{_cell((what or '').partition(chr(10) * 2)[0])}\n"
    yield from _table([row for row in rows if row not in shared])
    names = [_code(row[0].split(" ")[0].rstrip(",")) for row in rows if row in shared]
    if names:
        yield f"[{_TITLE}](#{_TITLE.lower().replace(' ', '-')}): {', '.join(names)}.\n"


def _table(rows: list[Row]) -> Iterator[str]:
    if rows:
        yield "| option | default | what it is |\n|---|---|---|"
        yield from (
            f"| {_written(name)} | {default} | {_cell(text)} |" for name, default, text in rows
        )
        yield ""


def _options(function: Callable[..., Any]) -> Iterator[Row]:
    """How each option of a command is written, its default, and its help."""
    hints = typing.get_type_hints(function, include_extras=True)
    for name, parameter in inspect.signature(function).parameters.items():
        if hints[name] is typer.Context:
            continue
        kind, info = _annotated(hints[name])
        default = _plain(parameter.default)
        plain = isinstance(default, str | int | float) and not isinstance(default, bool)
        shown = _code(str(default)) if plain and default != "" else ""
        choices = [str(_plain(one)) for one in _choices(kind)]
        value = info.metavar or "|".join(choices)
        if isinstance(info, typer.models.ArgumentInfo):
            yield value or name.upper(), shown, info.help or ""
            continue
        # inside Annotated typer takes the first of them for a default, until it makes the command
        first = [info.default] if isinstance(info.default, str) else []
        names = ", ".join([*first, *(info.param_decls or ())] or [f"--{name.replace('_', '-')}"])
        flag = kind is bool
        yield names if flag else f"{names} {value or 'VALUE'}", shown, info.help or ""


def _annotated(hint: Any) -> tuple[Any, Any]:
    """The type of an option and its metadata; Python 3.10 may say Optional around both."""
    while not hasattr(hint, "__metadata__"):
        hint = typing.get_args(hint)[0]
    return typing.get_args(hint)[0], hint.__metadata__[0]


def _choices(kind: Any) -> list[Any]:
    """What may be said, where that is a list."""
    if isinstance(kind, type) and issubclass(kind, Enum):
        return list(kind)
    if typing.get_origin(kind) is Literal:
        return list(typing.get_args(kind))
    return [choice for part in typing.get_args(kind) for choice in _choices(part)]


def _plain(value: Any) -> Any:
    return value.value if isinstance(value, Enum) else value


class _Arguments:
    """Collects the options of a command of the worker; their defaults are in the help."""

    def __init__(self) -> None:
        self.rows: list[Row] = []

    def add_argument(self, *names: str, **of: Any) -> None:
        if of["help"] == argparse.SUPPRESS:
            return
        # defaults that depend on the host are explained elsewhere
        text = re.sub(r" \(default here: .*\)$", "", of["help"])
        default = re.search(r" \(default: ([^)]*)\)", text)
        value = of.get("metavar") or "|".join(of.get("choices", ())) or "VALUE"
        written = ", ".join(names) if "action" in of else f"{', '.join(names)} {value}"
        if default is not None:
            text = text.replace(default[0], "")
        self.rows.append((written, _cell(default[1]) if default else "", text))


def _written(option: str) -> str:
    """The names in one piece, and each value in one, so that a narrow column can have them."""
    names, _, value = option.rpartition(" ")
    parts = [_code(names), " \\| ".join(_code(one) for one in value.split("|"))]
    return " ".join(parts) if names and value[0] != "-" else _code(option)


def _code(text: str) -> str:
    return "`" + text.replace("|", "\\|") + "`"


def _cell(text: str) -> str:
    plain = " ".join(text.split()).replace("``", "`")
    return re.sub(r"([|*_<>\[\]])", r"\\\1", plain)


if __name__ == "__main__":
    DOCUMENT.write_text(document())
