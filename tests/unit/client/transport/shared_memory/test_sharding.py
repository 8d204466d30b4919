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
SLOWER = Pace(Cost(10_000, 8_000), Cost(25_000, 14_000))
EQUAL = Pace(Cost(10_000, 8_000), Cost(25_000, 8_000))
environment = partial(env_manifest, Discrete(2), Discrete(2))


@pytest.fixture(autouse=True)
def _two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sharding, "CPUS", [0, 1])
    monkeypatch.setattr(sharding.os, "sched_getaffinity", lambda pid: {0, 1})


def sizes(*arguments: object) -> list[int]:
    """How many each shard gets."""
    return [stop - start for start, stop in bounds_for(*arguments)]  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("count", "workers", "pace", "expected"),
    [
        (16, None, None, [8, 8]),  # at first it is not known how long a step takes
        (16, None, SHORT, [10, 6]),  # a wake-up is worth four of these steps
        (16, None, SLOWER, [11, 5]),  # it shares a core, and so its caches
        (16, None, LONG, [8, 8]),  # a wake-up is nothing beside them
        (4, None, SHORT, [4]),  # these are done before a second shard is awake
        # a process more has to be worth its memory and its start
        *((4, 2, EQUAL, [3, 1]), (4, None, EQUAL, [4]), (16, None, EQUAL, [9, 7])),
        # a number of workers is kept, if there are as many sub-environments
        *((4, 2, SHORT, [3, 1]), (1, 2, SHORT, [1])),
    ],
)
def test_a_shard_gets_what_its_pace_is_worth(
    count: int, workers: int | None, pace: Pace | None, expected: list[int]
) -> None:
    """One that sleeps, or shares a core, gets less; one that brings little is not started."""
    assert sizes(environment(count), workers, pace) == expected


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
