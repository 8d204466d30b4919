"""The history of an environment: what is kept, in which order, and what gives way."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from envhub_sandbox.extras.crash import history
from envhub_sandbox.extras.crash.history import History
from envhub_worker.protocol import messages as m
from tests.support.compare import assert_same
from tests.support.wire import requested


def ask(kept: History, message: m.Message) -> None:
    kept.requested(requested(message))


def reset(kept: History, seeds: Any = None, mask: Any = None) -> None:
    ask(kept, m.Reset(0, seeds, None, mask))


def messages_of(kept: History) -> list[Any]:
    return [*map(m.unpack, kept.recording())]


def names_of(kept: History) -> list[str]:
    return [type(message).__name__ for message in messages_of(kept)]


def actions_of(kept: History) -> list[Any]:
    return [message.actions.tolist() for message in messages_of(kept) if type(message) is m.Step]


def test_what_outlives_a_reset_is_bounded() -> None:
    kept = History(10_000)
    for number in range(1000):
        ask(kept, m.Call(0, "f", (number,), {}))
    reset(kept, [1, 2])
    *calls, last = messages_of(kept)
    assert [call.args for call in calls] == [(number,) for number in range(744, 1000)]
    assert isinstance(last, m.Reset)


def test_what_shards_were_sent_is_kept_as_it_was_asked() -> None:
    """Each was sent its slice; the recording has the whole, as it was then."""
    kept, values = History(100), [np.zeros(2), np.ones(2), np.full(2, 7.0)]
    kept.requested(
        requested(
            m.Reset(5, [1, 2], {"a": 1}, np.array([True, False])),
            m.Reset(5, [3], {"a": 1}, np.array([True])),
        )
    )
    parts = (m.SetAttr(5, "x", tuple(half)) for half in (values[:2], values[2:]))
    kept.requested(requested(*parts))
    kept.requested(requested(m.Call(5, "f", (1,), {}), m.Call(5, "f", (1,), {})))
    kept.requested(requested(m.CallOne(5, None, 0, "g", (), {}), m.CallOne(5, 1, 0, "g", (), {})))
    values[0][:] = 9.0
    reset_of_all, set_for_all, called, called_one = messages_of(kept)
    assert_same(reset_of_all.seeds, [1, 2, 3])
    assert_same(reset_of_all.mask, np.array([True, False, True]))
    assert_same(set_for_all.values, (np.zeros(2), np.ones(2), np.full(2, 7.0)))
    assert called == m.Call(5, "f", (1,), {})
    assert called_one == m.CallOne(0, 3, 0, "g", (), {})


def test_requests_come_back_in_order() -> None:
    kept = History(100)
    reset(kept, [1, 2])
    kept.step(np.array([0, 1]))
    kept.step(np.array([2, 3], np.uint8))
    ask(kept, m.Render(0))
    kept.step([4, "a"])
    first, second, third, render, last = messages_of(kept)
    assert_same(first, m.Reset(0, [1, 2], None, None))
    assert_same(second.actions, np.array([0, 1]))
    assert_same(third.actions, np.array([2, 3], np.uint8))
    assert isinstance(render, m.Render)
    assert last.actions == [4, "a"]
    ask(kept, m.Call(0, "add", (object(),), {}))
    kept.step(np.array([object()], object))
    assert [repr(message).count("remote object") for message in messages_of(kept)[-2:]] == [1, 1]


def test_the_caller_may_change_his_actions() -> None:
    kept, array, options = History(100), np.array([1, 2]), {"b": [1]}
    for actions in (array, {"a": array}, [array.view(np.matrix)], np.array([array, None], object)):
        kept.step(actions)
    ask(kept, m.Reset(0, None, options, np.array([True, False])))
    array[:] = 0
    options["b"].append(2)
    flat, nested, listed, several, masked = messages_of(kept)
    for actions in (flat.actions, nested.actions["a"], listed.actions[0], several.actions[0]):
        assert actions.ravel().tolist() == [1, 2]
    assert masked.options == {"b": [1]}


def test_a_reset_that_seeds_all_begins_anew() -> None:
    kept = History(100)
    reset(kept)
    kept.step(np.array([1, 1]))
    reset(kept, [None, 3])
    reset(kept, [5, 6], np.array([True, False]))
    kept.requested(requested(m.Reset(0, [1], None, None), m.Reset(0, [None], None, None)))
    assert names_of(kept) == ["Reset", "Step", "Reset", "Reset", "Reset"]
    reset(kept, [7, 8])
    assert names_of(kept) == ["Reset"]


def test_attributes_and_calls_outlast_a_reset() -> None:
    kept = History(100)
    ask(kept, m.SetAttr(0, "a", (1, 1)))
    for argument in (1, 2, 1):
        ask(kept, m.Call(0, "add", (argument,), {}))
    ask(kept, m.CallOne(0, 0, 0, "step", (1,), {}))
    ask(kept, m.SetAttr(0, "a", (2, 2)))
    reset(kept, [1, 2])
    *before, last = messages_of(kept)
    assert isinstance(last, m.Reset)
    calls = [m.Call(0, "add", (argument,), {}) for argument in (2, 1)]
    assert before == [m.SetAttr(0, "a", (1, 1)), *calls, m.SetAttr(0, "a", (2, 2))]
    kept.started()
    reset(kept, [1, 2])
    assert names_of(kept) == ["Reset"]


@given(limit=st.integers(1, 40), steps=st.integers(0, 200))
def test_the_oldest_gives_way(limit: int, steps: int) -> None:
    kept = History(limit)
    for number in range(steps):
        kept.step(np.array([number, number]))
    assert actions_of(kept) == [[number] * 2 for number in range(max(0, steps - limit), steps)]


@pytest.mark.parametrize(
    "actions", [np.zeros((1, 1000)), {"a": np.zeros(1000)}, np.zeros((1, 1000)).view(np.matrix)]
)
def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch, actions: Any) -> None:
    monkeypatch.setattr(history, "HISTORY_BYTES", 100_000)
    kept = History(1000)
    for _ in range(100):
        kept.step(actions)
    assert 5 <= len(kept.recording()) <= 12
    for _ in range(30):
        ask(kept, m.Reset(0, None, {"map": np.zeros(5000)}, np.array([True])))
    assert len(kept.recording()) <= 3


def test_a_fresh_process_begins_anew() -> None:
    kept = History(100)
    part = kept.of_part()
    for owner in (kept, part):
        kept.step(np.array([1, 1]))
        owner.started()
        assert names_of(kept) == []
    part.requested(requested(m.Render(0)))
    part.step(np.array([3, 3]))
    assert names_of(kept) == ["Render"]
