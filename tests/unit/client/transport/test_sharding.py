"""Which shard gets how many sub-environments, and which core."""

from __future__ import annotations

from functools import partial

import pytest
from gymnasium.spaces import Discrete
from hypothesis import given
from hypothesis import strategies as st

from envhub_sandbox.transport.pace import Cost, Pace
from envhub_sandbox.transport.shared_memory import sharding
from envhub_sandbox.transport.shared_memory.sharding import bounds_for, place
from tests.support.wire import env_manifest

SHORT = Pace(Cost(10_000, 3_000), Cost(25_000, 3_000))
LONG = Pace(Cost(10_000, 2e6), Cost(25_000, 2e6))
environment = partial(env_manifest, Discrete(2), Discrete(2))


@pytest.fixture(autouse=True)
def _two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sharding, "CPUS", [0, 1])
    monkeypatch.setattr(sharding.os, "sched_getaffinity", lambda pid: {0, 1})


def sizes(*arguments: object) -> list[int]:
    """How many each shard gets."""
    return [stop - start for start, stop in bounds_for(*arguments)]  # type: ignore[arg-type]


def test_the_first_use_is_shared_out_evenly() -> None:
    """Nobody knows yet how long a step takes."""
    assert sizes(environment(16), None, None) == [8, 8]


def test_a_shard_that_sleeps_gets_less_of_short_steps() -> None:
    """Its wake-up is worth four of these steps."""
    assert sizes(environment(16), None, SHORT) == [10, 6]


def test_a_shard_whose_steps_are_slower_gets_less() -> None:
    """It shares a core, whose caches are somebody else's in between."""
    pace = Pace(Cost(10_000, 8_000), Cost(25_000, 14_000))
    assert sizes(environment(16), None, pace) == [11, 5]


def test_long_steps_are_shared_out_evenly() -> None:
    """A wake-up is nothing beside them."""
    assert sizes(environment(16), None, LONG) == [8, 8]


def test_a_shard_that_brings_nothing_is_not_started() -> None:
    """Four short steps are done before the second shard is awake."""
    assert sizes(environment(4), None, SHORT) == [4]


def test_a_shard_that_saves_little_is_not_started() -> None:
    """A process more has to be worth its memory and its start: these would save a step each."""
    pace = Pace(Cost(10_000, 8_000), Cost(25_000, 8_000))
    assert sizes(environment(4), 2, pace) == [3, 1]
    assert sizes(environment(4), None, pace) == [4]
    assert sizes(environment(16), None, pace) == [9, 7]


def test_a_number_of_workers_is_kept() -> None:
    """Who asks for two gets two, if there are two sub-environments."""
    assert sizes(environment(4), 2, SHORT) == [3, 1]
    assert sizes(environment(1), 2, SHORT) == [1]


@pytest.mark.parametrize("pace", [None, SHORT, LONG])
def test_what_may_share_state_stays_together(pace: Pace | None) -> None:
    """A SyncVectorEnv's sub-environments live in one process, and so does what is no such env."""
    assert sizes(environment(16, sync=True), None, pace) == [16]
    assert sizes(environment(16, shardable=False), 4, pace) == [16]


_COSTS = st.builds(Cost, *[st.floats(1, 1e12, exclude_max=True)] * 2)


@given(
    count=st.integers(1, 200),
    workers=st.none() | st.integers(1, 20),
    awake=_COSTS,
    asleep=st.none() | _COSTS,
)
def test_every_sub_environment_has_one_shard(
    count: int, workers: int | None, awake: Cost, asleep: Cost | None
) -> None:
    """Slices are adjacent, none is empty, and together they are all."""
    bounds = bounds_for(environment(count), workers, Pace(awake, asleep))
    assert [start for start, _ in bounds] == [0, *(stop for _, stop in bounds[:-1])]
    assert bounds[-1][1] == count
    assert all(start < stop for start, stop in bounds)


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
