"""Repositories of a jail's cache of the Hub are read within bounds; a client may send anything."""

from typing import Any

import pytest

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.protocol.runtime import MAX_HUB_COPIES, HubCopy, read_hub_copies

GOOD = ("models--org--repo", "ab" * 20, ("main", "v1.0", "refs/pr/3"), "/snapshots/x")


def test_what_is_sent_is_read() -> None:
    assert read_hub_copies([list(GOOD)]) == (HubCopy(*GOOD),)
    order = m.OpenJail("", "", "", "", "", {}, 1, (GOOD,))
    assert order.with_trees({"/snapshots/x": "/there"}) == ((*GOOD[:3], "/there"),)
    assert order.with_trees({}) == (GOOD,)


@pytest.mark.parametrize(
    "changes",
    [
        *({0: lie} for lie in ("models--../../etc", "models--org--repo/..", "homes--org--repo")),
        *({0: "models--org--repo\n"}, {0: 5}, {1: "main"}, {1: "../" + "a" * 37}),
        *({2: (lie,)} for lie in ("../../../passwd", "/etc/passwd", "a/../b")),
        *({2: ("main",) * 5}, {2: "main"}, {3: None}, {3: "x\0"}, {3: "x" * 5000}),
    ],
)
def test_what_there_cannot_be_is_refused(changes: dict[int, Any]) -> None:
    row = [changes.get(place, value) for place, value in enumerate(GOOD)]
    with pytest.raises(RemoteProtocolError):
        read_hub_copies((tuple(row),))


@pytest.mark.parametrize("value", [None, {}, "x", (GOOD[:3],), (GOOD, GOOD), (1,)])
def test_other_shapes_are_refused(value: Any) -> None:
    with pytest.raises(RemoteProtocolError):
        read_hub_copies(value)


def test_there_is_a_most() -> None:
    rows = [(f"models--org--r{n}", *GOOD[1:]) for n in range(MAX_HUB_COPIES + 1)]
    assert len(read_hub_copies(rows[1:])) == MAX_HUB_COPIES
    with pytest.raises(RemoteProtocolError):
        read_hub_copies(rows)
