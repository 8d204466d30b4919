"""Over how many processes sub-environments are spread: what was tried, and what was fastest."""

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import pytest
from gymnasium.spaces import Discrete
from hypothesis import given
from hypothesis import strategies as st

from envhub_sandbox.transport import shard_trials
from envhub_sandbox.transport.shard_trials import ShardTrials, ways_to_cut
from tests.support.wire import env_manifest

environment = partial(env_manifest, Discrete(2), Discrete(2))
ENV = environment(16)


def cores(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    monkeypatch.setattr(shard_trials, "own_cpus", lambda: list(range(count)))


@pytest.fixture(autouse=True)
def _two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    cores(monkeypatch, 2)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "entry.auto-shards"


def use(path: Path, times: Mapping[str, float], count: int = 16) -> str:
    """One use of a pin whose steps take that long; returns how it was cut."""
    env, trials = environment(count), ShardTrials(path)
    bounds = trials.bounds_for(env, None)
    name = "+".join(str(stop - start) for start, stop in bounds)
    for early in (1.9, 1.0):  # the last note of a use counts
        trials.note(env, bounds, early * times[name])
    return name


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        ({"8+8": 90e-6, "10+6": 80e-6, "16": 120e-6}, "10+6"),
        ({"8+8": 90e-6, "10+6": 95e-6, "16": 60e-6}, "16"),
        ({"8+8": 90e-6, "10+6": 100e-6, "16": 92e-6}, "16"),  # nearly as fast with fewer processes
        ({"8+8": 90e-6, "10+6": 100e-6, "16": 95e-6}, "8+8"),
    ],
)
def test_the_fastest_of_all_is_used(path: Path, times: dict[str, float], expected: str) -> None:
    assert [use(path, times) for _ in range(3)] == list(times)
    near = [name for name, step_s in times.items() if step_s < 1.3 * min(times.values())]
    assert [use(path, times) for _ in near] == near
    assert {use(path, times) for _ in range(5)} == {expected}


def test_fewer_are_not_tried_if_half_is_slower(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A use that is many times as slow would be a high price for what is known already."""
    cores(monkeypatch, 8)
    tried = ["1+1+1+1+1+1+1+1", "2+1+1+1+1+1+1", "2+2+2+2"]
    times = dict(zip(tried, (16e-3, 32e-3, 32e-3), strict=True))
    assert [use(path, times, 8) for _ in range(5)] == [*tried, tried[0], tried[0]]


WAYS = ("8+8", "10+6", "16")
QUIET = (160e-6, 150e-6, 100e-6)


@pytest.mark.parametrize(
    ("phases", "least"),
    [
        ([QUIET], 0.88),
        ([(100e-6, 108e-6, 150e-6)], 0.92),
        ([QUIET, (320e-6, 300e-6, 200e-6)], 0.8),  # a load that slows all down alike
        ([(100e-6, 110e-6, 120e-6), *3 * [(400e-6, 400e-6, 150e-6)]], 0.75),  # one that does not
    ],
)
def test_most_uses_are_nearly_the_fastest_despite_noise(
    path: Path, phases: list[tuple[float, ...]], least: float
) -> None:
    """A third of the uses takes up to twice as long as usual, and loads come and go."""
    best = uses = 0
    for seed in range(5):
        path.unlink(missing_ok=True)
        noise = Random(seed)
        for number in range(64):
            times = phases[number // 16 % len(phases)]
            late = 1 + noise.random() if noise.random() < 1 / 3 else 1 + noise.random() / 20
            name = use(path, {way: late * step_s for way, step_s in zip(WAYS, times, strict=True)})
            best += times[WAYS.index(name)] <= 1.1 * min(times)
            uses += 1
    assert best >= least * uses


def test_other_cores_are_another_machine(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for _ in range(6):
        use(path, {"8+8": 2e-4, "10+6": 2e-4, "16": 1e-4})
    cores(monkeypatch, 4)
    assert len(ShardTrials(path).bounds_for(ENV, None)) == 4
    cores(monkeypatch, 2)
    assert len(ShardTrials(path).bounds_for(ENV, None)) == 1


def test_what_may_share_state_stays_together(path: Path) -> None:
    """A SyncVectorEnv's sub-environments live in one process, and so does what is no such env. A
    number of workers is kept, whatever was measured, if there are as many sub-environments."""
    use(path, {"8+8": 1e-3})
    trials = ShardTrials(path)
    assert trials.bounds_for(environment(16, sync=True), None) == [(0, 16)]
    assert trials.bounds_for(environment(16, shardable=False), 4) == [(0, 16)]
    assert [len(trials.bounds_for(ENV, workers)) for workers in (1, 3, 20)] == [1, 3, 16]


@given(count=st.integers(1, 200), cpus=st.integers(1, 70))
def test_every_sub_environment_has_one_shard(count: int, cpus: int) -> None:
    ways = ways_to_cut(count, cpus)
    for bounds in ways:
        assert [start for start, _ in bounds] == [0, *(stop for _, stop in bounds[:-1])]
        assert bounds[-1][1] == count
        assert all(start < stop for start, stop in bounds)
        assert len(bounds) <= cpus
    assert len(ways[-1]) == 1


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]",
        b"{",
        b"\xff",
        *(
            json.dumps({'["", "0", 2]': notes}).encode()
            for notes in ({"8+8": 1e-3}, [1], [["8+8"]])
        ),
        *(json.dumps({'["", "0", 2]': [["8+8", s]]}).encode() for s in (0.0, -1.0, 1e9, True, "1")),
    ],
)
def test_a_damaged_file_is_as_none(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    assert (use(path, {"8+8": 1e-3}), use(path, {"10+6": 1e-3})) == ("8+8", "10+6")


@pytest.mark.parametrize(
    ("env", "step_s"),
    [
        *((ENV, one) for one in (0.0, float("nan"), float("inf"), -1.0)),
        *((environment(16, sync=True), 1e-3), (environment(1), 1e-3)),
    ],
)
def test_what_is_no_time_or_choice_is_not_remembered(path: Path, env: Any, step_s: float) -> None:
    """A clock may be strange; a cache that is not there or cannot be written is no error."""
    ShardTrials(path).note(env, [(0, env.num_envs)], step_s)
    assert not path.exists()
    ShardTrials(path.parent / "missing" / "entry").note(ENV, [(0, 16)], 1e-3)
    assert not (path.parent / "missing").exists()
    nowhere = ShardTrials(None)
    nowhere.note(ENV, [(0, 8), (8, 16)], 1e-3)
    assert nowhere.bounds_for(ENV, None) == [(0, 8), (8, 16)]


@pytest.mark.parametrize(
    ("changes", "apart", "processes"),
    [
        ({}, False, 2),
        ({}, True, 16),
        ({"independent": False}, False, 16),
        ({"sync": True, "independent": False}, True, 1),
    ],
)
def test_only_what_changes_nothing_is_left_to_speed(
    path: Path, changes: dict[str, Any], apart: bool, processes: int
) -> None:
    env, trials = environment(16, **changes), ShardTrials(path, apart=apart)
    assert len(trials.bounds_for(env, None)) == processes
    assert len(trials.bounds_for(env, 3)) == 3
    trials.note(env, trials.bounds_for(env, None), 1e-3)
    assert path.exists() == (processes == 2)
