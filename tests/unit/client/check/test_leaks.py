"""What counts as left behind: what every round adds."""

from __future__ import annotations

import itertools

import pytest

from envhub_sandbox.check.play import leaks

_MIB = 1 << 20


def seen(*rows: tuple[int, int, int, int]) -> list[leaks.Usage]:
    """One count after each round."""
    return [{"processes": p, "threads": t, "files": f, "memory_bytes": m} for p, t, f, m in rows]


@pytest.mark.parametrize(
    ("counts", "found"),
    [
        (seen((1, 0, 9, 0), (1, 0, 9, 0), (1, 0, 9, 0), (1, 0, 9, 0)), None),
        (
            seen((1, 0, 9, 0), (9, 8, 9, 90 * _MIB), (9, 8, 9, 90 * _MIB), (9, 8, 9, 90 * _MIB)),
            None,
        ),
        (seen((1, 0, 9, 0), (2, 1, 9, 1000), (3, 2, 9, 2000), (4, 3, 9, 3000)), None),
        (seen((1, 0, 9, 0), (9, 0, 9, 0), (17, 0, 9, 0), (25, 0, 9, 0)), "leaks-processes"),
        (seen((1, 0, 9, 0), (1, 8, 9, 0), (1, 16, 9, 0), (1, 24, 9, 0)), "leaks-threads"),
        (seen((1, 0, 3, 0), (1, 0, 9, 0), (1, 0, 15, 0), (1, 0, 21, 0)), "leaks-files"),
        (
            seen((1, 0, 9, 0), (1, 0, 9, 2 * _MIB), (1, 0, 9, 4 * _MIB), (1, 0, 9, 6 * _MIB)),
            "leaks-memory",
        ),
        (
            seen(
                (1, 0, 9, 0), (9, 8, 9, 90 * _MIB), (17, 16, 9, 190 * _MIB), (25, 24, 9, 290 * _MIB)
            ),
            "leaks-processes",
        ),
        ([], None),
    ],
    ids=[
        "level",
        "filled once",
        "jitter",
        "processes",
        "threads",
        "files",
        "memory",
        "all",
        "uncounted",
    ],
)
def test_what_grows_in_every_round_is_told(counts: list[leaks.Usage], found: str | None) -> None:
    """And of what comes with it nothing: a process has threads and memory of its own."""
    grew = leaks.leak(counts, 8)
    assert (grew[0] if grew else None) == found


def test_nobody_who_counts_is_no_count() -> None:
    """A server on another host may be an older one: then nothing is said, not that all is well."""
    numbers = itertools.count()
    assert leaks.usage_per_round(lambda: next(numbers), dict, 2, lambda what: None) == []
    assert next(numbers) == 8
