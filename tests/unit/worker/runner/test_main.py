"""The loop of a runner: a stream of requests, and the doorbell of the lane that it serves."""

import itertools
import mmap
import os
import socket
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import pytest

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.confinement import Confinement
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.stream import StreamReader, pack_packet
from envhub_worker.runner import runner
from envhub_worker.runner.described import raised
from envhub_worker.runner.lane import Lane, own_cores
from envhub_worker.runner.prefixes import Watches
from tests.support.processes import eventually


class QuietLane:
    """A lane of which nothing is asked; its doorbell is one end of a socket pair."""

    def __init__(self, number: int) -> None:
        self.number, self.was_awake = number, True
        client, own = socket.socketpair()
        self.client, self.bell = client, own.detach()

    def wake(self, *, alone: bool) -> bool:
        return bool(os.read(self.bell, 8))

    def look_again(self) -> None:
        self.was_awake = False

    def close(self) -> None:
        os.close(self.bell)
        self.bell = -1


@pytest.fixture
def slab_lane() -> tuple[Lane, Any, Any]:
    """A lane whose steps fail, and the words of its request and of its reply."""
    memory = [os.memfd_create(name) for name in ("request", "reply", "observations")]
    for fd in memory:
        os.ftruncate(fd, slabs.REPLY_BYTES)
    request, reply = (slabs.words(mmap.mmap(fd, slabs.REPLY_BYTES)) for fd in memory[:2])
    bells = [os.memfd_create("bell") for _ in range(2)]
    others: Any = [None, None, raised]
    attach = m.Attach(1, 0, 0, 1)
    steps: Any = [None] * 3
    lane = Lane(attach, None, *steps, [*memory, *bells], *others, (), Watches())
    return lane, request, reply


def test_a_lane_that_is_closed_owes_nothing(slab_lane: tuple[Lane, Any, Any]) -> None:
    """Or a jail in which another environment lives would be taken for busy for ever."""
    lane, request, reply = slab_lane
    request[slabs.SEQUENCE] = 5
    lane.close()
    assert reply[slabs.SEQUENCE] == 5


def test_a_client_that_is_always_quick_does_not_keep_its_runner_from_the_server(
    slab_lane: tuple[Lane, Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Or a close and a reset of another environment in this runner would wait for it."""
    lane, request, reply = slab_lane
    request[slabs.SPIN], request[slabs.CHANGES] = 10**9, 1
    most, clock = 10_000, itertools.count(0, 10**8)

    def now_and_ask_again() -> int:
        request[slabs.SEQUENCE] = min(reply[slabs.SEQUENCE] + 1, most)
        return next(clock)

    monkeypatch.setattr("envhub_worker.runner.lane.perf_counter_ns", now_and_ask_again)
    request[slabs.SEQUENCE] = 1
    lane.wake(alone=True)
    assert reply[slabs.SEQUENCE] < most
    assert reply[slabs.PARKED]
    assert lane.was_awake  # so that the runner looks again soon: its client may not have rung
    lane.close()


def test_a_runner_stays_on_the_cores_that_its_user_gave_it(
    slab_lane: tuple[Lane, Any, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with ``taskset``: whatever core a lane avoids or keeps to, and back to any."""
    cores, kept = {1, 2, 5}, []
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(cores))

    def keep(_: int, chosen: set[int]) -> None:
        cores.intersection_update(chosen)
        kept.append(set(chosen))

    monkeypatch.setattr(os, "sched_setaffinity", keep)
    own_cores.cache_clear()
    lane, request, _ = slab_lane
    for word in (slabs.AVOIDED + 1 + 2, 1 + 5, 0):
        request[slabs.CPU] = word
        request[slabs.CHANGES] += 1
        request[slabs.SEQUENCE] += 1
        assert lane.serve()
    own_cores.cache_clear()
    lane.close()
    assert kept == [{1, 5}, {5}, {1, 2, 5}]


def test_a_client_may_close_one_lane_and_then_another(monkeypatch: pytest.MonkeyPatch) -> None:
    lanes = [QuietLane(1), QuietLane(2)]
    attached = iter(lanes)

    def answer(self: Any, packet: Any) -> list[Any]:
        for lane in [next(attached, None)]:
            self.lanes.update({} if lane is None else {lane.number: lane})
        return m.pack(m.Value(True))

    monkeypatch.setattr(runner.Runner, "answer", answer)
    monkeypatch.setattr(runner.WarningLog, "listen", lambda self: None)
    client, stream = socket.socketpair()
    client.settimeout(30)
    spec: Any = SimpleNamespace(confinement=Confinement(), snapshot="", entry="")

    def ask(number: int) -> None:
        client.sendall(b"".join(map(bytes, pack_packet(number, m.pack(m.FetchInfos(0))))))
        reader = StreamReader()
        while not list(reader.feed(client.recv(reader.chunk))):
            pass

    with ThreadPoolExecutor() as pool, client, stream:
        done = pool.submit(runner.main, stream, spec, [])
        try:
            ask(1), ask(2)
            for lane in lanes:
                lane.client.close()
            ask(3), ask(4)
            assert eventually(lambda: [lane.bell for lane in lanes] == [-1, -1])
        finally:
            client.shutdown(socket.SHUT_WR)
            assert done.result(timeout=60) == 0
