"""What episodes leave behind: processes, threads, files and memory, counted from outside."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from envhub_worker.protocol.text import size_text

_ROUNDS = 3
_LEAST = {"processes": 2, "threads": 2, "files": 2, "memory_bytes": 1 << 20}
"""What a round has to add. Pools that are filled once, and the allocator, add less or once."""
_CHECKS = {
    "processes": "leaks-processes",
    "threads": "leaks-threads",
    "files": "leaks-files",
    "memory_bytes": "leaks-memory",
}

Usage = dict[str, int]


def watch(
    begin: Callable[[], Any],
    usage: Callable[[], Usage],
    resets: int,
    tell: Callable[[str], None] = lambda what: None,
) -> list[Usage]:
    """What is held after each round of resets; a first round warms up. Empty if nothing counts.

    Args:
        begin: Resets all sub-environments, and steps them.
        usage: What its jail holds.
        resets: Of each round.
        tell: Is called with the name of each round.
    """
    seen = []
    for number in range(_ROUNDS + 1):
        tell(f"{resets} resets, round {number + 1} of {_ROUNDS + 1}")
        for _ in range(resets):
            begin()
        seen.append(usage())
    return seen if all(seen) else []


def grown(seen: Sequence[Usage], resets: int) -> Iterator[tuple[str, str]]:
    """The check of each thing that grew in every round, and in what words.

    A process that was left has threads and memory of its own, and pipes to it; a thread has a
    stack: only the first of them is reported.
    """
    told = False
    for what, check in _CHECKS.items():
        counts = [one[what] for one in seen]
        steps = [after - before for before, after in itertools.pairwise(counts)]
        grows = bool(steps) and min(steps) >= _LEAST[what]
        if grows and not told:
            is_memory = what == "memory_bytes"
            each = ", ".join(map(size_text if is_memory else str, counts))
            yield check, f"{'memory' if is_memory else what} after each {resets} resets: {each}"
        told = told or grows


def checks() -> tuple[str, ...]:
    """What can be found."""
    return tuple(_CHECKS.values())
