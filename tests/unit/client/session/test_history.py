"""The history of an environment: what is kept, in which order, and what gives way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from envhub_sandbox.session.crash import history
from envhub_sandbox.session.crash.history import (
    History,
    PartHistory,
    RecordedRequest,
    Recording,
    Steps,
)
from envhub_worker.protocol import messages as m
from tests.support.compare import assert_same
from tests.support.wire import env_manifest, requested


def made(space: Any = None, num_envs: int = 2, limit: int = 1000) -> History:
    """A history of an environment with this single action space."""
    single = spaces.Discrete(5) if space is None else space
    return History(env_manifest(spaces.Discrete(2), single, num_envs), limit)


def ask(kept: History, message: m.Message) -> None:
    kept.requested(requested(message))


def reset(kept: History, seeds: Any = None, mask: Any = None) -> None:
    ask(kept, m.Reset(0, seeds, None, mask))


def test_what_outlives_a_reset_is_bounded() -> None:
    """A program that calls with another argument after each step fills nothing."""
    kept = made(limit=10_000)
    for number in range(1000):
        ask(kept, m.Call(0, "f", (number,), {}))
    reset(kept, [1, 2])
    recording = kept.recording()
    assert len(recording.requests) == 257
    assert recording.dropped == 744


def test_what_shards_were_sent_is_kept_as_it_was_asked() -> None:
    """Each was sent its slice; the recording has the whole, as it was then."""
    kept, values = made(num_envs=3), [np.zeros(2), np.ones(2), np.full(2, 7.0)]
    kept.requested(
        requested(
            m.Reset(5, [1, 2], {"a": 1}, np.array([True, False])),
            m.Reset(5, [3], {"a": 1}, np.array([True])),
        )
    )
    kept.requested(
        requested(m.SetAttr(5, "x", tuple(values[:2])), m.SetAttr(5, "x", tuple(values[2:])))
    )
    kept.requested(requested(m.Call(5, "f", (1,), {}), m.Call(5, "f", (1,), {})))
    kept.requested(requested(m.CallOne(5, None, 0, "g", (), {}), m.CallOne(5, 1, 0, "g", (), {})))
    values[0][:] = 9.0
    recording = kept.recording()
    assert recording.exact
    found = [m.unpack(one.frames) for one in recording.requests if isinstance(one, RecordedRequest)]
    assert [one.operation for one in recording.requests if isinstance(one, RecordedRequest)] == [
        *("reset", "setattr", "call", "callone")
    ]
    reset_of_all, set_for_all, called, called_one = found
    assert isinstance(reset_of_all, m.Reset)
    assert isinstance(set_for_all, m.SetAttr)
    assert_same(reset_of_all.seeds, [1, 2, 3])
    assert_same(reset_of_all.mask, np.array([True, False, True]))
    assert_same(set_for_all.values, (np.zeros(2), np.ones(2), np.full(2, 7.0)))
    assert called == m.Call(5, "f", (1,), {})
    assert called_one == m.CallOne(0, 3, 0, "g", (), {})


def actions_of(recording: Recording) -> list[Any]:
    runs = [request.actions for request in recording.requests if isinstance(request, Steps)]
    return [row.tolist() for run in runs for row in run]


def names_of(recording: Recording) -> list[str]:
    return [one.operation for one in recording.requests if isinstance(one, RecordedRequest)]


def test_requests_come_back_in_order() -> None:
    """Steps in a row are one array; whatever lies between them keeps its place."""
    kept = made()
    reset(kept, [1, 2])
    kept.step(np.array([0, 1]))
    kept.step(np.array([2, 3]))
    ask(kept, m.Render(0))
    kept.step(np.array([4, 4]))
    first, steps, render, last = kept.recording().requests
    assert isinstance(first, RecordedRequest)
    assert_same(m.unpack(first.frames), m.Reset(0, [1, 2], None, None))
    assert isinstance(steps, Steps)
    assert_same(steps.actions, np.array([[0, 1], [2, 3]]))
    assert isinstance(render, RecordedRequest)
    assert isinstance(last, Steps)
    assert kept.recording().exact
    ask(kept, m.Call(0, "add", (object(),), {}))
    described = kept.recording().requests[-1]
    assert isinstance(described, RecordedRequest)
    assert not kept.recording().exact, "what only pickle could carry is not the thing itself"
    assert "remote object" in repr(m.unpack(described.frames))
    nothing = made(limit=0)  # which turns it off
    reset(nothing, [1, 2])
    nothing.step(np.array([1, 2]))
    assert nothing.recording() == Recording()


@given(st.lists(st.sampled_from(["int64", "int32", "uint8"]), max_size=12))
def test_every_step_keeps_its_dtype(dtypes: list[str]) -> None:
    kept = made()
    expected = [np.array([1, 2], dtype) for dtype in dtypes]
    for actions in expected:
        kept.step(actions)
    runs = kept.recording().requests
    found = [row for run in runs if isinstance(run, Steps) for row in run.actions]
    assert_same(found, expected)


def test_the_caller_may_change_his_actions() -> None:
    """What was sent is kept, whatever becomes of the array, the mapping or the options."""
    flat = made()
    array = np.array([1, 2])
    flat.step(array)
    array[:] = 0
    assert actions_of(flat.recording()) == [[1, 2]]
    nested = made(spaces.Dict(a=spaces.Discrete(3)))
    parts = {"a": np.array([1, 2])}
    nested.step(parts)
    parts["a"][:] = 0
    [request] = nested.recording().requests
    assert isinstance(request, RecordedRequest)
    step: Any = m.unpack(request.frames)
    assert_same(step.actions, {"a": np.array([1, 2])})
    options = {"level": [1]}
    ask(flat, m.Reset(0, None, options, np.array([True, False])))
    options["level"].append(2)
    last = flat.recording().requests[-1]
    assert isinstance(last, RecordedRequest)
    kept: Any = m.unpack(last.frames)
    assert kept.options == {"level": [1]}


def test_a_reset_that_seeds_all_begins_anew() -> None:
    """One without seeds, or of some sub-environments only, goes on."""
    kept = made()
    reset(kept, [1, 2])
    kept.step(np.array([1, 1]))
    reset(kept)
    reset(kept, [None, 3])
    reset(kept, [5, 6], np.array([True, False]))
    assert names_of(kept.recording()) == ["reset"] * 4
    assert kept.recording().seeded
    reset(kept, [7, 8])
    assert names_of(kept.recording()) == ["reset"]
    assert actions_of(kept.recording()) == []


def test_what_was_never_seeded_is_called_so() -> None:
    """Then only the last reset counts: nobody knows what came before it either."""
    kept = made()
    reset(kept)
    kept.step(np.array([1, 1]))
    reset(kept, [1, None])
    assert not kept.recording().seeded
    assert names_of(kept.recording()) == ["reset"]


def test_attributes_and_calls_outlast_a_reset() -> None:
    """The last of each name comes before everything else; with arguments, each of them."""
    kept = made()
    ask(kept, m.SetAttr(0, "a", (1, 1)))
    ask(kept, m.Call(0, "task", (), {}))
    ask(kept, m.Call(0, "add", (1,), {}))
    ask(kept, m.Call(0, "add", (2,), {}))
    ask(kept, m.Call(0, "task", (), {}))
    ask(kept, m.SetAttr(0, "a", (2, 2)))
    reset(kept, [1, 2])
    found = [one for one in kept.recording().requests if isinstance(one, RecordedRequest)]
    *before, last = [m.unpack(one.frames) for one in found]
    assert isinstance(last, m.Reset)
    assert [(type(one).__name__, one.name) for one in before] == [  # type: ignore[attr-defined]
        ("Call", "add"),
        ("Call", "add"),
        ("Call", "task"),
        ("SetAttr", "a"),
    ]
    assert before[-1] == m.SetAttr(0, "a", (2, 2))
    kept.started()
    reset(kept, [1, 2])
    assert names_of(kept.recording()) == ["reset"]


@given(limit=st.integers(1, 40), steps=st.integers(0, 200))
def test_the_oldest_gives_way(limit: int, steps: int) -> None:
    """At most as many as the limit says, the newest ones, and the rest is counted."""
    kept = made(limit=limit)
    for number in range(steps):
        kept.step(np.array([number, number]))
    found = actions_of(kept.recording())
    assert len(found) <= limit
    assert found == [[number, number] for number in range(steps - len(found), steps)]
    assert kept.recording().dropped == steps - len(found)
    assert kept.recording().exact is (steps == len(found))
    assert len(found) >= min(steps, limit - limit // 64 - 2)


@pytest.mark.parametrize(
    "space", [spaces.Box(-1, 1, (1000,)), spaces.Dict(a=spaces.Box(-1, 1, (1000,)))]
)
def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch, space: Any) -> None:
    monkeypatch.setattr(history, "HISTORY_BYTES", 100_000)
    kept = made(space, 1, limit=1000)
    actions: Any = np.zeros((1, 1000))
    for _ in range(100):
        kept.step({"a": actions} if isinstance(space, spaces.Dict) else actions)
    assert 5 <= 100 - kept.recording().dropped <= 12
    for _ in range(30):
        ask(kept, m.Reset(0, None, {"map": np.zeros(5000)}, np.array([True])))
    assert len(kept.recording().requests) <= 3


@pytest.mark.parametrize("of_a_fleet", ["", "started", "revived"])
def test_after_a_transparent_restart_nobody_knows_before_all_are_seeded(of_a_fleet: str) -> None:
    """Then it is exact again, unless attributes had been set that only some still have."""
    kept = made()
    part = PartHistory(env_manifest(spaces.Discrete(2), spaces.Discrete(5), 1), kept)
    reset(kept, [1, 2])
    kept.step(np.array([1, 1]))
    if of_a_fleet:  # one of its workers is fresh
        getattr(part, of_a_fleet)()
    else:
        kept.revived()
    kept.step(np.array([2, 2]))
    assert not kept.recording().seeded
    assert actions_of(kept.recording()) == [[2, 2]]
    reset(kept, [1, 2])
    assert kept.recording().seeded
    assert kept.recording().exact
    ask(kept, m.SetAttr(0, "a", (1, 1)))
    kept.revived()
    reset(kept, [1, 2])
    assert not kept.recording().exact
    kept.started()
    assert kept.recording().exact
