"""Watched attributes are known until they change; what has arrived stays until it is taken."""

import threading
import time
from collections.abc import Iterator
from unittest.mock import Mock

import pytest

from envhub_sandbox.errors import EnvHubError, WorkerTimeoutError
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.jail import JailHandle, WatchedAttributes, open_jail
from envhub_sandbox.transport.lane import Lane, answered_first
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from envhub_worker.protocol.messages.prefix import CHANGES
from tests.support.in_process.fake_lane import FakeLane
from tests.support.in_process.fake_server import FakeServer

REPLY = m.pack(m.Value(1))


@pytest.mark.parametrize("ends", [WorkerTimeoutError("the deadline came"), KeyboardInterrupt()])
def test_a_jail_that_opens_too_late_is_ended(ends: BaseException) -> None:
    """The server opens it after nobody waits for it; without its number nobody could end it."""
    client = Mock(receive=Mock(side_effect=ends))
    client.reply_again.return_value = m.JailOpened(7, (0,), ())
    order = m.OpenJail("a", "b", "c", "d", "e", {}, 1)
    with pytest.raises(type(ends)):
        open_jail(client, order, DEFAULT_LIMITS, Deadline(None))
    assert client.request.call_args.args == (m.CloseJail(7),)


def test_what_has_changed_is_no_longer_known() -> None:
    cache = WatchedAttributes()
    for name in ("task", "size"):
        assert cache.note(7, name, ("a", None))
    assert cache.take(CHANGES.put([(7, "task"), (8, "size")], REPLY)) == REPLY
    assert (cache.values(7, "task"), cache.values(7, "size")) == (None, ("a", None))


def test_what_can_change_without_a_word_is_not_kept() -> None:
    """Values of mutable types; and all of it where a reply had no room for changes."""
    cache = WatchedAttributes()
    assert not cache.note(7, "task", ("a", ["b"]))
    assert cache.values(7, "task") is None
    cache.note(7, "task", ("a", "b"))
    assert cache.take(REPLY * DEFAULT_LIMITS.frames) == REPLY * DEFAULT_LIMITS.frames
    assert cache.values(7, "task") is None


def test_what_has_arrived_is_shown_and_stays() -> None:
    """As the frames of each runner; nothing of a reply that is refused when it is taken."""
    server = FakeServer()
    jail = JailHandle(server, 1, [1, 2], [], DEFAULT_LIMITS)
    wrong: list[m.Message] = [
        m.RelayDone((1,)),
        m.RelayDone((3,)),
        m.RelayDone((1, 1)),
        m.RelayDone((4, -1)),
        m.RelayDone((1, 1, 1)),
        m.RelayDone((1, 2), (0,)),
        m.Death(1, "exit", 1),
        m.Done(),
    ]
    for reply in wrong:
        sent = jail.relay("step", [(1, REPLY), (2, REPLY)])
        assert jail.arrived(sent) == []
        server.reply(reply, REPLY, REPLY, REPLY, to=sent)
        assert jail.arrived(sent) == []
        with pytest.raises(EnvHubError):
            jail.receive(sent, Deadline(0))
    sent = jail.relay("step", [(1, REPLY), (2, REPLY)])
    server.answer(REPLY, REPLY)
    for _ in range(2):
        assert jail.arrived(sent) == [REPLY, REPLY]
    assert jail.receive(sent, Deadline(0)) == [m.Value(1)] * 2
    assert jail.arrived(sent) == []


def test_what_the_next_request_makes_useless_is_not_kept() -> None:
    """A runner that can have infos asked for, and then not taken, fills no memory with them."""
    server = FakeServer()
    jail = JailHandle(server, 1, [1], [], DEFAULT_LIMITS)
    results = Mock(slices=[(0, 1)])
    lane = Lane(jail, [1], 7, results)
    for _ in range(100):
        lane.send_some("step", [1], [REPLY])
        server.answer(REPLY)
        assert lane.answered()
        assert server.untaken == 1
    lane.send_some("step", [1], [REPLY], ahead=True)
    server.answer(REPLY)
    assert server.untaken == 2
    for _ in range(2):
        assert lane.replies(Deadline(0)) == [m.Value(1)]
    assert server.untaken == 0


# --- Of several lanes the first that answers is found, whatever the others claim


@pytest.fixture
def lanes() -> Iterator[list[FakeLane]]:
    made = [FakeLane(), FakeLane(), FakeLane()]
    for lane in made:
        lane.silent = True
    yield made
    for lane in made:
        lane.close()


def found(lanes: list[FakeLane], timeout_s: float | None) -> list[int]:
    return answered_first(lanes, Deadline(timeout_s))


def test_who_has_answered_is_found_at_once(lanes: list[FakeLane]) -> None:
    """All of them, in order, also where the deadline has passed; nothing is listened to. A deadline
    ends the wait for others."""
    lanes[0].silent = lanes[2].silent = False
    assert (found(lanes, 0), found(lanes, None)) == ([0, 2], [0, 2])
    assert not any(lane.listened for lane in lanes)
    lanes[0].silent = lanes[2].silent = True
    assert found(lanes, 0.05) == []


def test_a_ring_ends_the_sleep(lanes: list[FakeLane], monkeypatch: pytest.MonkeyPatch) -> None:
    """Whichever lane it comes from: without it, this would take an hour."""
    monkeypatch.setattr("envhub_sandbox.transport.lane.LOOK_MS", 3_600_000)

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


def test_endless_rings_hide_no_other(
    lanes: list[FakeLane], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hostile runner rings and never answers: another's answer is found, and the deadline is."""
    monkeypatch.setattr("envhub_sandbox.transport.lane.LOOK_MS", 5)
    lanes[0].ring()  # and it stays readable
    assert found(lanes, 0.05) == []
    looks = iter(range(20))
    lanes[1].on_look = lambda: setattr(lanes[1], "silent", next(looks) < 10)
    assert found(lanes, None) == [1]
