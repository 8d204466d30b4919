"""Short forms of ``monkey`` and ``clients``, and that they notice what they look for."""

import json
from typing import Any

import numpy as np
import pytest

from tests.faults.endurance import clients, monkey


def _result(**changes: Any) -> Any:
    parts = {"first": np.zeros(2), "second": np.ones(2), "infos": {"a": np.array([True])}}
    return tuple({**parts, **changes}.values())


def test_a_difference_would_be_noticed() -> None:
    assert monkey.same(_result(), _result())
    assert not monkey.same(_result(), _result(infos={}))
    assert not monkey.same(_result(), _result(second=np.zeros(2)))
    assert not monkey.same(_result(), _result(first=np.zeros(2, np.float32)))


def test_a_short_hour(capsys: pytest.CaptureFixture[str]) -> None:
    code = monkey.main(["--operations", "6", "--kill-every", "2", "--environments", "2"])
    found = json.loads(capsys.readouterr().out)
    assert code == 0, found
    for place in monkey.PLACES:
        assert found[place]["compared"] > 0
        assert found[place]["deaths"] > 0


def test_the_monkey_would_notice_an_uncaused_death(monkeypatch: pytest.MonkeyPatch) -> None:
    one = monkey.Monkey("process", environments=1, seed=0, kill_every=3)
    monkeypatch.setattr(monkey.Subject, "doubted", lambda _: None)
    while not one.mismatches and one.counts["operations"] < 1000:
        one.once()
    one.rest()
    assert any("WorkerDiedError" in said for said in one.mismatches)


def test_short_clients_leave_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    code = clients.main(["--in-a-row", "2"])
    assert (code, json.loads(capsys.readouterr().out)["grown"]) == (0, [])


@pytest.mark.parametrize("slack", [clients.SLACK, monkey.SLACK])
def test_growth_would_be_noticed(slack: dict[str, float]) -> None:
    """Of anything that is looked at, beyond what one look differs from the next."""
    flat = dict.fromkeys([*slack, "jails"], 20.0)
    assert clients.more(flat, flat, slack) == []
    for name in flat:
        grown = clients.more(flat, {**flat, name: flat[name] + 100}, slack)
        assert grown == [name]
        assert not monkey.passed({"mismatches": [], "grown": grown})
    assert not monkey.passed({"mismatches": ["one"], "grown": []})
