"""Of several lanes the first that answers is found, whatever the others claim."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any, cast

import pytest

from envhub_sandbox.transport import readiness
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.readiness import answered_first
from tests.support.in_process.fake_lane import FakeLane


@pytest.fixture
def lanes() -> Iterator[list[FakeLane]]:
    made = [FakeLane(), FakeLane(), FakeLane()]
    for lane in made:
        lane.silent = True
    yield made
    for lane in made:
        lane.close()


def found(lanes: list[FakeLane], timeout_s: float | None) -> list[int]:
    return answered_first(cast("list[Any]", lanes), Deadline(timeout_s))


def test_who_has_answered_is_found_at_once(lanes: list[FakeLane]) -> None:
    """All of them, in order, also where the deadline has passed; nothing is listened to."""
    lanes[0].silent = lanes[2].silent = False
    assert found(lanes, 0) == [0, 2]
    assert found(lanes, None) == [0, 2]
    assert not any(lane.listened for lane in lanes)


def test_a_deadline_ends_the_wait(lanes: list[FakeLane]) -> None:
    assert found(lanes, 0.05) == []
    lanes[1].silent = False
    assert found(lanes, 0) == [1]


def test_a_ring_ends_the_sleep(lanes: list[FakeLane], monkeypatch: pytest.MonkeyPatch) -> None:
    """Whichever lane it comes from: without it, this would take an hour."""
    monkeypatch.setattr(readiness, "LOOK_MS", 3_600_000)

    def answer() -> None:
        while not lanes[1].listened:
            time.sleep(0.001)
        lanes[1].silent = False
        lanes[1].ring()

    thread = threading.Thread(target=answer)
    thread.start()
    assert found(lanes, None) == [1]
    thread.join()


def test_an_answer_that_crosses_with_the_listening_is_found(lanes: list[FakeLane]) -> None:
    lanes[2].on_listen = lambda: setattr(lanes[2], "silent", False)
    assert found(lanes, None) == [2]


def test_endless_rings_hide_no_other(lanes: list[FakeLane]) -> None:
    """A hostile runner rings and never answers: another's answer is found, and the deadline is."""
    lanes[0].ring()  # and it stays readable
    assert found(lanes, 0.05) == []
    looks = iter(range(50))
    lanes[1].on_look = lambda: setattr(lanes[1], "silent", next(looks) < 40)
    assert found(lanes, None) == [1]
