"""``docs/settings.md``, written from the docstrings and defaults of what it describes.
Write it again with ``python -m tests.support.documents.settings``."""

import dataclasses
import inspect
import re
from collections.abc import Iterator
from typing import Any

from envhub_sandbox import Limits, Policy, Timeouts, make_env
from tests.support.documents.written import DOCS, filled

DOCUMENT = DOCS / "settings.md"
_UNITS = ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB"))


def document() -> str:
    parts = ["## `make_env`\n", *_table(make_env, "Args", _arguments())]
    for kind in (Policy, Limits, Timeouts):
        summary = (inspect.getdoc(kind) or "").partition("\n\n")[0]
        parts += [f"## `{kind.__name__}`\n", f"{_markdown(summary)}\n"]
        parts += _table(kind, "Attributes", _defaults(kind))
    return filled(DOCUMENT, written="\n".join(parts))


def _arguments() -> dict[str, str]:
    found = inspect.signature(make_env).parameters.values()
    return {one.name: _default(one.name, one.default) for one in found}


def _defaults(kind: type[Any]) -> dict[str, str]:
    made = kind()
    return {
        item.name: _default(item.name, getattr(made, item.name))
        for item in dataclasses.fields(kind)
    }


def _default(name: str, value: Any) -> str:
    if value is inspect.Parameter.empty:
        return ""
    if isinstance(value, Limits):
        return "`Limits()`"
    if name.endswith("_bytes") and isinstance(value, int):
        size, unit = next((size, unit) for size, unit in _UNITS if value % size == 0)
        return f"{value // size} {unit}"
    return f"`{value!r}`"


def _table(described: Any, section: str, defaults: dict[str, str]) -> list[str]:
    texts = dict(_section(inspect.getdoc(described) or "", section))
    assert texts.keys() == defaults.keys(), texts.keys() ^ defaults.keys()
    rows = [f"| `{name}` | {defaults[name]} | {_markdown(texts[name])} |" for name in defaults]
    return ["\n".join(["| name | default | what it is |", "|---|---|---|", *rows]) + "\n"]


def _section(text: str, title: str) -> Iterator[tuple[str, str]]:
    """Names and texts of one section of a docstring in Google's style."""
    body = text.partition(f"{title}:\n")[2].partition("\n\n")[0]
    for entry in re.split(r"\n(?=    \w)", body):
        name, _, words = entry.strip().partition(": ")
        yield name, words


def _markdown(text: str) -> str:
    return re.sub(r"\s+", " ", text.replace("``", "`")).replace("|", "\\|")


if __name__ == "__main__":
    DOCUMENT.write_text(document())
