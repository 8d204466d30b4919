"""Which shard runs on which core."""

from __future__ import annotations

import pytest

from envhub_sandbox.transport.shared_memory import cores
from envhub_sandbox.transport.shared_memory.cores import Cores, place


@pytest.mark.parametrize("client", [0, 1, 2, 3])
@pytest.mark.parametrize("shards", [1, 2, 3, 4, 9])
def test_a_shard_that_waits_awake_is_not_on_the_clients_core(shards: int, client: int) -> None:
    """The client would have to push it away at every step."""
    cpus = [0, 1, 2, 3]
    awake = min(shards, len(cpus) - 1)
    placed = [cpu - 1 for cpu in place(shards, awake, client, cpus)]
    assert client not in placed[:awake]
    assert len(set(placed[:awake])) == awake
    assert set(placed) <= set(cpus)


def test_the_first_that_sleeps_shares_the_clients_core() -> None:
    """It works while the client sleeps; further ones take the other cores in turn."""
    assert place(4, 1, 0, [0, 1]) == [2, 1, 2, 1]


def test_one_core_holds_all_shards() -> None:
    """Where there is one core, all shards are on it."""
    assert place(2, 0, 5, [5]) == [6, 6]


@pytest.mark.parametrize(("shards", "awake"), [(1, 1), (2, 1), (3, 1)])
def test_one_core_is_the_clients(monkeypatch: pytest.MonkeyPatch, shards: int, awake: int) -> None:
    """Shards that find no other core sleep."""
    monkeypatch.setattr(cores, "CPUS", [0, 1])
    assert Cores(shards).awake == awake
