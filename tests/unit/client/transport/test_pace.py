"""What is made of measured steps once an environment is closed, and what is remembered of it."""

from __future__ import annotations

import contextlib
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from gymnasium.spaces import Discrete

from envhub_sandbox.transport.pace import ASK_NS, Cost, Pace, PaceBook, PaceMeter, Sample, pace_of
from tests.support.wire import env_manifest

SHORT = Pace(Cost(10_000, 3_000), Cost(25_000, 3_000))
LONG = Pace(Cost(10_000, 2e6), Cost(25_000, 2e6))


ENV = env_manifest(Discrete(2), Discrete(2), 2)


def step_ns(meter: PaceMeter, steps: int, *busy_ns: int) -> float:
    """How long a step is, where wake-ups are not known."""
    pace = meter.pace(steps, busy_ns)
    assert pace is not None
    assert pace == Pace(Cost(ASK_NS, pace.awake.step_ns), None)
    return pace.awake.step_ns


def test_a_life_without_samples_tells_how_long_a_step_is() -> None:
    """One was measured, in each shard; what was disturbed is longer."""
    meter = PaceMeter([2, 2], awake=1)
    assert step_ns(meter, 256, 14_000, 90_000) == step_ns(meter, 5_000, 90_000, 14_000) == 7_000
    assert step_ns(PaceMeter([4], awake=1), 256, 28_000) == 7_000


def test_in_a_short_life_steps_count_as_shorter() -> None:
    """It does not make up for the start of a process more; but a long step stays a long one."""
    meter = PaceMeter([4], awake=1)
    assert step_ns(meter, 128, 28_000) == 3_500
    assert step_ns(meter, 61, 28_000) == step_ns(meter, 33, 28_000) == 1_750


def test_a_life_without_a_measured_step_tells_nothing() -> None:
    """Nor does one of which a shard has measured none."""
    meter = PaceMeter([2, 2], awake=1)
    assert meter.pace(31, (0, 0)) is None
    assert meter.pace(61, (14_000, 0)) is None


def test_wake_ups_are_told_by_a_long_life_only() -> None:
    """One or two samples say little of what depends on whoever runs beside."""
    meter = PaceMeter([2, 2], awake=1)
    meter.sample((14_000, 20_000), slept_ns=60_000, elapsed_ns=61_000)
    early = meter.pace(64, (14_000, 20_000))
    late = meter.pace(256, (14_000, 20_000))
    assert early is not None
    assert early.asleep is None
    assert late is not None
    assert late.asleep == Cost(40_000, 10_000)


def test_what_a_shard_costs_is_told_from_what_was_waited_for() -> None:
    """Who was waited for last tells when it had begun; the others only when they were done."""
    slow = [Sample(slept=100_000, elapsed=100_500, asleep=60_000, awake=50)] * 3
    assert pace_of(slow, asleep=6, awake=10) == Pace(Cost(25_000, 5), Cost(40_000, 10_000))
    late = [Sample(slept=80_000, elapsed=120_000, asleep=50_000, awake=100_000) for _ in range(3)]
    assert pace_of(late, asleep=5, awake=10) == Pace(Cost(20_000, 10_000), Cost(30_000, 10_000))


def test_one_hiccup_changes_no_pace() -> None:
    """The median step decides."""
    usual = Sample(slept=80_000, elapsed=120_000, asleep=50_000, awake=100_000)
    hiccup = Sample(slept=4_000_000, elapsed=4_100_000, asleep=60_000, awake=3_900_000)
    assert pace_of([hiccup, usual, usual], 5, 10) == pace_of([usual], 5, 10)


def test_a_pace_is_remembered(tmp_path: Path) -> None:
    """For one environment of many, until another is noted."""
    book = PaceBook(tmp_path / "entry.pace")
    other = replace(ENV, task=1)
    assert book.of(ENV) is None
    book.note(ENV, SHORT)
    book.note(other, LONG)
    assert (book.of(ENV), book.of(other)) == (SHORT, LONG)


def test_a_use_without_a_sleeping_shard_forgets_a_little(tmp_path: Path) -> None:
    """A machine that was busy once is not taken for a busy one for ever."""
    book = PaceBook(tmp_path / "entry.pace")
    book.note(ENV, Pace(SHORT.awake, Cost(1e6, 9_000)))
    for _ in range(30):
        book.note(ENV, Pace(SHORT.awake, None))
    assert book.of(ENV) == SHORT


def test_what_one_step_took_is_believed_in_part(tmp_path: Path) -> None:
    """Another process may have run in its midst; what is as long each time is so in the end."""
    book = PaceBook(tmp_path / "entry.pace")
    noted = []
    for step_ns in (3_000, 2e6, 4_000, 2e6, 2e6):
        book.note(ENV, Pace(Cost(10_000, step_ns), None))
        pace = book.of(ENV)
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
    assert PaceBook(path).of(ENV) is None


def test_nothing_is_written_where_nothing_may_be_remembered() -> None:
    """Arguments without a stable form have no entry, and no pace."""
    book = PaceBook(None)
    book.note(ENV, SHORT)
    assert book.of(ENV) is None


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
        PaceBook(tmp_path / "entry.pace").note(ENV, SHORT)
    assert list(tmp_path.iterdir()) == []
