"""A short form of ``benchmarks/soak.py``: with faults all along, every result is the oracle's."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from benchmarks import soak
from tests.support import inside


@pytest.mark.usefixtures("neighbour")
@pytest.mark.parametrize(
    ("lane", "workers", "restart"),
    [("auto", 2, "transparent"), ("frames", 2, "transparent"), ("auto", 1, "on_reset")],
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
    """The comparison is not satisfied by anything but the very same results."""
    assert soak.same(_result(), _result())
    assert not soak.same(_result(), _result(infos={}))
    assert not soak.same(_result(), _result(second=np.zeros(2)))
    assert not soak.same(_result(), _result(first=np.zeros(2, np.float32)))


def test_soak_would_notice_growth() -> None:
    """Neither memory, nor descriptors, nor processes may become more."""
    flat = {"processes": 4, "client_descriptors": 9, "client_mib": 80.0}
    found: dict[str, Any] = {"mismatches": 0, "after_warm_up": flat, "at_the_end": flat}
    assert soak.passed(found)
    for name, value in (("processes", 5), ("client_descriptors", 20), ("client_mib", 200.0)):
        assert not soak.passed({**found, "at_the_end": {**flat, name: value}})
    assert not soak.passed({**found, "mismatches": 1})
