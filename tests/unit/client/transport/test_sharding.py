"""Who gets how many sub-environments, and what is remembered of them."""

from __future__ import annotations

import contextlib
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from envhub_sandbox.transport.pace import Cost, Pace
from envhub_sandbox.transport.shared_memory import sharding
from envhub_sandbox.transport.shared_memory.sharding import (
    PaceBook,
    Sample,
    bounds_for,
    pace_of,
)
from envhub_worker.protocol.manifest.manifest import EnvManifest

SHORT = Pace(Cost(10_000, 3_000), Cost(25_000, 3_000))
LONG = Pace(Cost(10_000, 2e6), Cost(25_000, 2e6))


@pytest.fixture(autouse=True)
def _two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sharding, "CPUS", [0, 1])
    monkeypatch.setattr(sharding.os, "sched_getaffinity", lambda pid: {0, 1})


def environment(count: int, *, sync: bool = False, shardable: bool = True) -> EnvManifest:
    """An environment of so many sub-environments."""
    space = spaces.Discrete(2)
    return EnvManifest(
        suite="suite",
        task=0,
        num_envs=count,
        single_observation_space=space,
        single_action_space=space,
        observation_space=spaces.MultiDiscrete([2] * count),
        action_space=spaces.MultiDiscrete([2] * count),
        autoreset_mode="NextStep",
        metadata={},
        render_mode=None,
        spec=None,
        attributes=(),
        shardable=shardable,
        sync=sync,
        type_name="",
    )


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


def test_what_a_shard_costs_is_told_from_what_was_waited_for() -> None:
    """Who was waited for last tells when it had begun; the others only when they were done."""
    slow = [Sample(slept=100, elapsed=100, asleep=60, awake=50) for _ in range(3)]
    slow = [replace(one, slept=100_000, elapsed=100_500, asleep=60_000) for one in slow]
    assert pace_of(slow, asleep=6, awake=10) == Pace(Cost(25_000, 5), Cost(40_000, 10_000))
    late = [Sample(slept=80_000, elapsed=120_000, asleep=50_000, awake=100_000) for _ in range(3)]
    assert pace_of(late, asleep=5, awake=10) == Pace(Cost(20_000, 10_000), Cost(30_000, 10_000))


def test_one_hiccup_changes_no_pace() -> None:
    """The median step decides."""
    usual = Sample(slept=80_000, elapsed=120_000, asleep=50_000, awake=100_000)
    hiccup = Sample(slept=4_000_000, elapsed=4_100_000, asleep=60_000, awake=3_900_000)
    assert pace_of([hiccup, usual, usual], 5, 10) == pace_of([usual], 5, 10)


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


def test_a_pace_is_remembered(tmp_path: Path) -> None:
    """For one environment of many, until another is noted."""
    book = PaceBook(tmp_path / "entry.pace")
    env, other = environment(2), replace(environment(2), task=1)
    assert book.of(env) is None
    book.note(env, SHORT)
    book.note(other, LONG)
    assert (book.of(env), book.of(other)) == (SHORT, LONG)


def test_a_use_without_a_sleeping_shard_forgets_a_little(tmp_path: Path) -> None:
    """A machine that was busy once is not taken for a busy one for ever."""
    book = PaceBook(tmp_path / "entry.pace")
    env = environment(2)
    book.note(env, Pace(SHORT.awake, Cost(1e6, 9_000)))
    for _ in range(30):
        book.note(env, Pace(SHORT.awake, None))
    assert book.of(env) == SHORT


def test_what_one_step_took_is_believed_in_part(tmp_path: Path) -> None:
    """Another process may have run in its midst; what is as long each time is so in the end."""
    book = PaceBook(tmp_path / "entry.pace")
    env = environment(2)
    noted = []
    for step_ns in (3_000, 2e6, 4_000, 2e6, 2e6):
        book.note(env, Pace(Cost(10_000, step_ns), None))
        pace = book.of(env)
        assert pace is not None
        noted.append(pace.awake.step_ns)
    assert noted == [3_000, 6_000, 4_000, 8_000, 16_000]


_SPOILT = ([3_000, 15_000], [1, 1, 0, -1], [1, math.nan, 1, 1], [1, True, 1, 1], 7)


@pytest.mark.parametrize(
    "text",
    ["", "[]", *(json.dumps({'["suite", "0"]': pace}) for pace in _SPOILT)],
)
def test_an_unreadable_book_is_empty(tmp_path: Path, text: str) -> None:
    """A cache that somebody spoilt costs speed and nothing else."""
    path = tmp_path / "entry.pace"
    path.write_text(text)
    assert PaceBook(path).of(environment(2)) is None


def test_nothing_is_written_where_nothing_may_be_remembered() -> None:
    """Arguments without a stable form have no entry, and no pace."""
    book = PaceBook(None)
    book.note(environment(2), SHORT)
    assert book.of(environment(2)) is None


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_a_pace_that_cannot_be_written_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    """A full disk is no error, Ctrl-C is one; neither leaves half a file behind."""

    def fails(*arguments: object) -> None:
        raise error

    monkeypatch.setattr("os.replace", fails)
    told = contextlib.nullcontext() if error is OSError else pytest.raises(error)
    with told:
        PaceBook(tmp_path / "entry.pace").note(environment(2), SHORT)
    assert list(tmp_path.iterdir()) == []
