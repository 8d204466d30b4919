"""A short form of ``benchmarks/clients.py``: clients come and go, and the server is as it was."""

from __future__ import annotations

import json
from typing import Any

import pytest

from benchmarks import clients


def test_short_clients_leave_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    """Nor do those that are there at once; and a client may have several environments."""
    code = clients.main(["--in-a-row", "4", "--at-once", "2", "--environments", "3"])
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
