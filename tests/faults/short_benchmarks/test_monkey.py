"""A short form of ``benchmarks/monkey.py``: whatever is done in whatever order, the model holds."""

from __future__ import annotations

import json
from typing import Any

import pytest

from benchmarks import monkey


def test_a_short_hour(capsys: pytest.CaptureFixture[str]) -> None:
    """In child processes and over TCP: no result differs, nothing grows."""
    code = monkey.main(["--operations", "60", "--kill-every", "3", "--environments", "3"])
    found = json.loads(capsys.readouterr().out)
    assert code == 0, found
    for place in monkey.PLACES:
        assert found[place]["compared"] > 0
        assert found[place]["deaths"] > 0


def test_the_monkey_would_notice_a_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of every result, and it goes on with the others."""
    one = monkey.Monkey("process", environments=2, seed=0, kill_every=10**9)
    monkeypatch.setattr(monkey, "same", lambda *_: False)
    for _ in range(10):
        one.once()
    one.rest()
    assert one.mismatches
    assert len(one.mismatches) == one.counts["compared"]


def test_the_monkey_would_notice_a_death_that_nobody_caused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The model allows a death only where something was killed."""
    one = monkey.Monkey("process", environments=1, seed=0, kill_every=3)
    monkeypatch.setattr(monkey.Subject, "doubted", lambda _: None)
    while not one.mismatches and one.counts["operations"] < 1000:
        one.once()
    one.rest()
    assert any("WorkerDiedError" in said for said in one.mismatches)


def test_the_monkey_would_notice_growth() -> None:
    """Neither files, nor descriptors, nor processes may become more."""
    flat = {"processes": 5, "client_descriptors": 22, "client_mib": 35.0, "files": 6}
    found: dict[str, Any] = {"mismatches": [], "grown": monkey.more(flat, flat)}
    assert monkey.passed(found)
    for name in flat:
        grown = monkey.more(flat, {**flat, name: flat[name] + 100})
        assert grown == [name]
        assert not monkey.passed({**found, "grown": grown})
    assert not monkey.passed({**found, "mismatches": ["one"]})
