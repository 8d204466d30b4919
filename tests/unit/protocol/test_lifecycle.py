"""The table of an environment's life: what is legal, and what is not."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from envhub_worker.protocol.lifecycle import TABLE, Event, Lifecycle, State


def after(*events: Event) -> State:
    lifecycle = Lifecycle()
    for event in events:
        lifecycle.on(event)
    return lifecycle.state


def test_an_illegal_move_is_refused_and_changes_nothing() -> None:
    lifecycle = Lifecycle()
    with pytest.raises(RuntimeError, match="no move from IDLE on REPLY"):
        lifecycle.on(Event.REPLY)
    assert lifecycle.state is State.IDLE


@given(st.lists(st.sampled_from(Event), max_size=12))
def test_close_is_legal_at_every_moment_and_final(events: list[Event]) -> None:
    lifecycle = Lifecycle()
    for event in events:
        if (lifecycle.state, event) in TABLE:
            lifecycle.on(event)
    if lifecycle.state is not State.CLOSED:
        lifecycle.on(Event.CLOSE)
    assert lifecycle.state is State.CLOSED
    assert not [event for event in Event if (State.CLOSED, event) in TABLE]


def test_a_late_reply_is_never_the_answer_to_a_new_request() -> None:
    """After a timeout or an interrupt nothing is submitted before it has come or been given up."""
    assert after() is State.IDLE
    assert after(Event.START, Event.SUBMIT, Event.INTERRUPT) is State.LATE
    late = (Event.START, Event.SUBMIT, Event.TIMEOUT)
    assert after(*late) is State.LATE
    assert after(*late, Event.REPLY) is State.READY
    assert after(*late, Event.FORGET) is State.IDLE


def test_what_is_legal_in_each_state() -> None:
    legal = {state: {event for one, event in TABLE if one is state} for state in State}
    for state in (State.LATE, State.PENDING):
        assert Event.SUBMIT not in legal[state], "requests are answered one at a time"
    assert [one for one in State if Event.REPLY in legal[one]] == [State.PENDING, State.LATE]
    assert legal[State.DEAD] == {Event.FORGET, Event.CLOSE, Event.FORK}
    # in a fork every environment that was open is another process's, and stays so
    assert legal[State.FOREIGN] == {Event.CLOSE, Event.FORK}
    for state in set(State) - {State.CLOSED}:
        assert TABLE[state, Event.FORK] is State.FOREIGN


def test_every_state_can_be_reached() -> None:
    reached = {State.IDLE}
    while more := {TABLE[key] for key in TABLE if key[0] in reached} - reached:
        reached |= more
    assert reached == set(State)
