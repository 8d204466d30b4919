"""Which core each shard keeps to."""

from __future__ import annotations

import pytest

from envhub_sandbox.transport.shared_memory.affinity import place


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


def test_one_core_holds_everybody() -> None:
    """Where there is one core, all shards are on it."""
    assert place(2, 0, 5, [5]) == [6, 6]
