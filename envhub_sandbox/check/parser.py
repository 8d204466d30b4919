"""Parses a stranger's Python in a process that may be lost over it.

``parsing.py`` runs this file by its path, alone in a fresh interpreter: it imports the standard
library and nothing else. Stdin has each file behind its length (four bytes, big endian), stdout
gets one line of JSON for each, in the same order: what it imports and calls, or ``null``.
"""

from __future__ import annotations

import ast
import json
import resource
import signal
import sys
import warnings
from collections.abc import Iterator
from typing import Any

MEMORY = 1 << 30
"""Bytes: Python's parser takes a thousand for each of a hostile text."""
CPU_S = 20.0
"""For one file; 256 KiB that a person wrote take less than one."""
OUTPUT = 64 << 20
MOST = 10_000
"""Imports and calls that are told of one file."""
LONGEST = 1024
"""Of a module, as a path of a file can be."""


def bound() -> None:
    """From here on the kernel ends us, or refuses us memory."""
    for what, most in (
        (resource.RLIMIT_AS, MEMORY),
        (resource.RLIMIT_FSIZE, OUTPUT),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_NOFILE, 8),
    ):
        hard = resource.getrlimit(what)[1]
        least = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(what, (least, least))
    signal.signal(signal.SIGPROF, signal.SIG_DFL)


def described(data: bytes) -> dict[str, Any] | None:
    """What a file imports and calls; None of what is no Python (of this version)."""
    try:
        # as text: of bytes, a stranger's own first line would choose the codec, and some take hours
        tree = ast.parse(data.decode("utf-8-sig"))
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return None
    unguarded = {id(node) for node in _unguarded(tree)}
    found: dict[str, Any] = {"imports": [], "calls": []}
    for node in ast.walk(tree):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            found["imports"].append([*_import(node), id(node) in unguarded, node.lineno])
        elif isinstance(node, ast.Call) and (name := _dotted(node.func)):
            found["calls"].append([name[:LONGEST], node.lineno])
    return {kind: rows[:MOST] for kind, rows in found.items()}


def _import(node: ast.Import | ast.ImportFrom) -> list[Any]:
    names = list(dict.fromkeys(alias.name[:LONGEST] for alias in node.names))[:MOST]
    if isinstance(node, ast.Import):
        return [-1, "", names]
    return [node.level, (node.module or "")[:LONGEST], names]


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


def _dotted(node: ast.expr) -> str:
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
        return f"{node.value.id}.{node.attr}"
    return ""


def main() -> None:
    """Answer for each file; what a file costs beyond its share ends us."""
    bound()
    warnings.simplefilter("ignore")  # the parser shows a stranger's lines with its own
    while head := sys.stdin.buffer.read(4):
        data = sys.stdin.buffer.read(int.from_bytes(head, "big"))
        signal.setitimer(signal.ITIMER_PROF, CPU_S)
        line = json.dumps(described(data))
        sys.stdout.write(f"{line}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
