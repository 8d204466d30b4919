"""What a server on another host says of itself: its own words, of the types that there are."""

from __future__ import annotations

from typing import Any

import pytest

from envhub_sandbox.sandboxes.server_facts import facts_of
from envhub_worker.protocol import messages as m

ANSWER: dict[Any, Any] = {
    "python": "3.12.1", "profile": "strict", "weakest_profile": "no-userns", "network": True,
    "quotas": {"jails": 4}, "clients": {"alice": {"jails": 1}}, "draining_s": None,
}  # fmt: skip


def test_what_it_says_is_kept() -> None:
    """What it may enforce lies between its strongest profile and the weakest that it permits."""
    found = facts_of(m.Welcome(1, "0.1.0", 7), 0.5, ANSWER)
    assert (found.detailed, found.network, found.gpu, found.draining) == (True, True, False, False)
    assert (found.quotas, found.used) == ({"jails": 4}, {"jails": 1})
    known = [one for one in ("strict", "no-userns", "container", "lax") if found.enforces(one)]
    assert known == ["strict", "no-userns"]


@pytest.mark.parametrize("lie", [3, "text", [], {"a": 1.5, "b": -1, "c": True, "d": 1 << 63}, None])
def test_other_types_are_nothing(lie: object) -> None:
    """Neither numbers that are none, nor words that would paint, nor many of them."""
    found = facts_of(
        m.Welcome(1, "\x1b[2J" * 100, 7), 0.5, dict.fromkeys(ANSWER, lie) | {"python": "\x1b[2J"}
    )
    assert (found.quotas, found.used, found.network) == ({}, {}, False)
    assert found.version.isprintable()
    assert found.python.isprintable()
    assert not found.enforces("strict")
    flood = {"quotas": {str(number): number for number in range(1000)}}
    assert len(facts_of(m.Welcome(1, "0", 7), 0.5, flood).quotas) == 32
