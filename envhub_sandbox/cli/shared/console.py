"""What the command line prints, and how text from a worker gets there without doing harm."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from envhub_worker.protocol.text import printable

if TYPE_CHECKING:
    from rich.console import Console

_PLAIN_WIDTH = 120
"""Columns where there is no terminal to ask."""
_LINE = 200


def console(*, stderr: bool = False) -> Console:
    """A console on stdout or stderr. Interprets no markup: texts may be a stranger's."""
    from rich.console import Console

    class PipeConsole(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError  # rich would exit by itself, with a code of its own

    stream = sys.stderr if stderr else sys.stdout
    return PipeConsole(
        file=stream,
        markup=False,
        highlight=False,
        emoji=False,
        width=None if stream.isatty() else _PLAIN_WIDTH,
    )


def say(text: str, style: str | None = None) -> None:
    """Print a message on stderr."""
    console(stderr=True).print(text, style=style, soft_wrap=True)


def safe_text(text: object, limit: int = 16_384) -> str:
    """Text that a terminal only prints: control characters escaped, length bounded."""
    return printable(str(text), limit)


def safe_line(text: object, limit: int = _LINE) -> str:
    """The same on one line, cut at its end."""
    line = printable(str(text), limit=10 * limit).replace("\n", " ").replace("\t", " ")
    return line if len(line) <= limit else f"{line[: limit - 1]}…"


def size_of(count: float) -> str:
    """Bytes in a unit that people read."""
    for unit in ("B", "KiB", "MiB"):
        if count < 1024:
            return f"{count:.0f} {unit}"
        count /= 1024
    return f"{count:.1f} GiB"


def print_json(document: Mapping[str, Any]) -> None:
    """Print one document on stdout, as JSON that every parser takes."""
    text = json.dumps(plain(document), indent=2, allow_nan=False, ensure_ascii=True)
    # GitHub's runner obeys it wherever it stands in a line; it can stand in texts alone
    sys.stdout.write(text.replace("##[", "#\\u0023[") + "\n")
    sys.stdout.flush()


def plain(value: Any) -> Any:
    """What JSON knows: arrays become lists, numbers that are not finite null, the rest text."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):  # arrays and numpy's scalars
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (bool, int, str)) else safe_text(value)
