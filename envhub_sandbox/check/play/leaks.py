"""What episodes leave behind: processes, threads, files and memory, counted from outside."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

from envhub_worker.protocol.text import size_text

_ROUNDS = 3
_LEAST = {
    "processes": ("leaks-processes", 2),
    "threads": ("leaks-threads", 2),
    "files": ("leaks-files", 2),
    "memory_bytes": ("leaks-memory", 1 << 20),
}
"""The check of each, and what a round has to add: pools that are filled once, and the allocator,
add less or once."""
LEAK_CHECKS = tuple(check for check, _ in _LEAST.values())

Usage = dict[str, int]


def usage_per_round(
    begin: Callable[[], Any],
    usage: Callable[[], Usage],
    resets: int,
    tell: Callable[[str], None],
) -> list[Usage]:
    """What is held after each round of resets; a first round warms up. Empty if nothing counts."""
    seen = []
    for number in range(_ROUNDS + 1):
        tell(f"{resets} resets, round {number + 1} of {_ROUNDS + 1}")
        for _ in range(resets):
            begin()
        seen.append(usage())
    return seen if all(seen) else []


def leak(seen: Sequence[Usage], resets: int) -> tuple[str, str] | None:
    """The check of what grew in every round, and in what words; None if nothing did.

    A process that was left has threads and memory of its own, and pipes to it; a thread has a
    stack: only the first of them is reported.
    """
    for what, (check, least) in _LEAST.items():
        counts = [one[what] for one in seen]
        steps = [after - before for before, after in itertools.pairwise(counts)]
        if steps and min(steps) >= least:
            name, words = ("memory", size_text) if what == "memory_bytes" else (what, str)
            return check, f"{name} after each {resets} resets: {', '.join(map(words, counts))}"
    return None
