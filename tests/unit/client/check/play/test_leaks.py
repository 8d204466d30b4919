"""What counts as left behind: what every round adds."""

from __future__ import annotations

import itertools

import pytest

from envhub_sandbox.check.play import probes

_MIB = 1 << 20


def seen(*rows: tuple[int, int, int, int]) -> list[probes.Usage]:
    """One count after each round."""
    return [{"processes": p, "threads": t, "files": f, "memory_bytes": m} for p, t, f, m in rows]


_GROWTH: dict[str, tuple[list[probes.Usage], str | None]] = {
    "level": (seen(*[(1, 0, 9, 0)] * 4), None),
    "filled once": (seen((1, 0, 9, 0), *[(9, 8, 9, 90 * _MIB)] * 3), None),
    "jitter": (seen(*((1 + n, n, 9, 1000 * n) for n in range(4))), None),
    "processes": (seen(*((1 + 8 * n, 0, 9, 0) for n in range(4))), "leaks-processes"),
    "threads": (seen(*((1, 8 * n, 9, 0) for n in range(4))), "leaks-threads"),
    "files": (seen(*((1, 0, 3 + 6 * n, 0) for n in range(4))), "leaks-files"),
    "memory": (seen(*((1, 0, 9, 2 * n * _MIB) for n in range(4))), "leaks-memory"),
    "all": (seen(*((1 + 8 * n, 8 * n, 9, 100 * n * _MIB) for n in range(4))), "leaks-processes"),
    "uncounted": ([], None),
}


@pytest.mark.parametrize(("counts", "found"), _GROWTH.values(), ids=_GROWTH)
def test_what_grows_in_every_round_is_told(counts: list[probes.Usage], found: str | None) -> None:
    """And of what comes with it nothing: a process has threads and memory of its own."""
    grew = probes.leak(counts, 8)
    assert (grew[0] if grew else None) == found


def test_nobody_who_counts_is_no_count() -> None:
    """A server on another host may be an older one: then nothing is said, not that all is well."""
    numbers = itertools.count()
    assert probes.usage_per_round(lambda: next(numbers), dict, 2, lambda what: None) == []
    assert next(numbers) == 8
