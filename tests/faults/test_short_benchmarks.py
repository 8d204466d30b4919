"""Short forms of ``benchmarks``: ``soak``, ``monkey``, ``clients``, ``auto``; what they notice."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from benchmarks import auto, clients, monkey, soak
from tests.support import inside


@pytest.mark.usefixtures("neighbour")
@pytest.mark.parametrize(
    ("lane", "workers", "restart"),
    [("auto", 2, "transparent"), ("frames", 1, "on_reset")],
)
def test_short_soak(
    lane: str,
    workers: int,
    restart: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Deaths, kills, stalls and time-outs among many steps: no result differs, nothing grows."""
    monkeypatch.setattr(*inside.LATE_REPLY_GRACE, 0.2)
    short = ["--steps", "400", "--fault-every", "20", "--seed", "3", "--restart", restart]
    code = soak.main([*short, "--lane", lane, "--num-workers", str(workers)])
    found = json.loads(capsys.readouterr().out)[lane]
    assert code == 0, found
    assert found["mismatches"] == 0
    done = [name for name in ("slow", "late", "stalls", "hangs", "exits", "kills") if found[name]]
    assert len(done) == 6, found
    assert bool(found["revived_rows"]) is (restart == "transparent")


def _result(**changes: Any) -> Any:
    parts = {"first": np.zeros(2), "second": np.ones(2), "infos": {"a": np.array([True])}}
    return tuple({**parts, **changes}.values())


def test_soak_would_notice_a_difference() -> None:
    assert soak.same(_result(), _result())
    assert not soak.same(_result(), _result(infos={}))
    assert not soak.same(_result(), _result(second=np.zeros(2)))
    assert not soak.same(_result(), _result(first=np.zeros(2, np.float32)))


def test_soak_would_notice_growth() -> None:
    flat = {"processes": 4, "client_descriptors": 9, "client_mib": 80.0}
    found: dict[str, Any] = {"mismatches": 0, "after_warm_up": flat, "at_the_end": flat}
    assert soak.passed(found)
    for name, value in (("processes", 5), ("client_descriptors", 20), ("client_mib", 200.0)):
        assert not soak.passed({**found, "at_the_end": {**flat, name: value}})
    assert not soak.passed({**found, "mismatches": 1})


def test_a_short_hour(capsys: pytest.CaptureFixture[str]) -> None:
    code = monkey.main(["--operations", "20", "--kill-every", "2", "--environments", "2"])
    found = json.loads(capsys.readouterr().out)
    assert code == 0, found
    for place in monkey.PLACES:
        assert found[place]["compared"] > 0
        assert found[place]["deaths"] > 0


def test_the_monkey_would_notice_a_difference(monkeypatch: pytest.MonkeyPatch) -> None:
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
    one = monkey.Monkey("process", environments=1, seed=0, kill_every=3)
    monkeypatch.setattr(monkey.Subject, "doubted", lambda _: None)
    while not one.mismatches and one.counts["operations"] < 1000:
        one.once()
    one.rest()
    assert any("WorkerDiedError" in said for said in one.mismatches)


def test_the_monkey_would_notice_growth() -> None:
    flat = {"processes": 5, "client_descriptors": 22, "client_mib": 35.0, "files": 6}
    found: dict[str, Any] = {"mismatches": [], "grown": monkey.more(flat, flat)}
    assert monkey.passed(found)
    for name in flat:
        grown = monkey.more(flat, {**flat, name: flat[name] + 100})
        assert grown == [name]
        assert not monkey.passed({**found, "grown": grown})
    assert not monkey.passed({**found, "mismatches": ["one"]})


def test_short_clients_leave_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    """Nor do those that are there at once; and a client may have several environments."""
    code = clients.main(["--in-a-row", "2", "--at-once", "2", "--environments", "3"])
    found = json.loads(capsys.readouterr().out)
    assert (code, found["grown"]) == (0, [])
    assert found["at_once"]["jails_pss_mib"] > 0
    assert found["environments"]["processes"] > found["at_once"]["processes"]


def test_growth_would_be_noticed() -> None:
    """Of anything that is looked at, beyond what one look differs from the next."""
    flat = {"server_pss_mib": 50.0, "descriptors": 20, "threads": 4, "folders": 3, "jails": 0}
    found: dict[str, Any] = {"after_a_tenth": flat, "at_the_end": flat}
    assert clients.grows(found) == []
    for name in flat:
        found["at_the_end"] = {**flat, name: flat[name] + 100}
        assert clients.grows(found) == [name]


def test_short_auto(capsys: pytest.CaptureFixture[str]) -> None:
    short = ["--rounds", "1", "--seconds", "0.01", "--busy", "1"]
    auto.main(["--workloads", "cartpole", "--sizes", "2", *short])
    header, _, row = [line for line in capsys.readouterr().out.splitlines() if "|" in line]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert len(cells) == header.count("|") - 1
    assert cells[:2] == ["CartPole", "2"]
    assert all(cells)
