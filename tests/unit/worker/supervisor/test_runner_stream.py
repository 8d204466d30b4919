"""The stream to one runner: what was asked is answered in order, and nothing else is taken."""

import os
import select
import socket
import tracemalloc
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.protocol.limits import WireLimits
from envhub_worker.protocol.stream import Packet, pack_packet
from envhub_worker.supervisor.runner_stream import RunnerLink


@pytest.fixture
def ends() -> Iterator[tuple[RunnerLink, socket.socket]]:
    """The server's end, and the runner's."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        yield RunnerLink(ours, WireLimits()), theirs


def packet(number: int) -> bytes:
    return b"".join(map(bytes, pack_packet(number, [b"said"])))


def test_answers_find_who_asked(ends: tuple[RunnerLink, socket.socket]) -> None:
    link, runner = ends
    for number in (1, 2):
        link.send(number, [b"asked"], f"owner {number}")
    assert link.receive() == []
    said = packet(1) + packet(2)
    runner.sendall(said[:-1])
    assert [owner for _, owner in link.receive() or ()] == ["owner 1"]
    runner.sendall(said[-1:])
    assert [owner for _, owner in link.receive() or ()] == ["owner 2"]
    assert (link.received, list(link.pending)) == (len(said), [])
    runner.close()
    assert link.receive() is None
    link.send(3, [b"asked"], "nobody")
    assert not link.wants_write


def test_a_large_answer_is_read_to_where_it_stays(ends: tuple[RunnerLink, socket.socket]) -> None:
    """No second copy of it is made, and no byte of the next answer is taken for its own."""
    link, runner = ends
    for number in (1, 2):
        link.send(number, [b"asked"], f"owner {number}")
    large = os.urandom(4 << 20)
    said = b"".join(map(bytes, pack_packet(1, [b"said", large]))) + packet(2)
    answers: list[tuple[Packet, Any]] = []
    tracemalloc.start()
    with ThreadPoolExecutor(1) as sender:
        sender.submit(runner.sendall, said)
        while len(answers) < 2:
            select.select([link], [], [])
            answers += link.receive() or ()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert [owner for _, owner in answers] == ["owner 1", "owner 2"]
    assert bytes(answers[0][0].frames[1]) == large
    assert link.received == len(said)
    assert len(large) < peak < len(large) + (1 << 18)


@pytest.mark.parametrize("lies", [(2,), (1, 1), (1, 7)])
def test_an_answer_that_nobody_asked_for_is_refused(
    ends: tuple[RunnerLink, socket.socket], lies: tuple[int, ...]
) -> None:
    link, runner = ends
    for number in (1, 2):
        link.send(number, [b"asked"], f"owner {number}")
    runner.sendall(b"".join(map(packet, lies)))
    with pytest.raises(RemoteProtocolError, match="it owes"):
        link.receive()
    assert set(link.pending) == {1, 2}


def test_a_runner_that_never_reads_delays_nobody(ends: tuple[RunnerLink, socket.socket]) -> None:
    link, runner = ends
    large = bytes(8 << 20)
    link.send(1, [b"", large], "owner")
    assert link.wants_write
    seen = 0
    while seen < link.sent:
        seen += len(runner.recv(1 << 20))
        link.flush()
    assert not link.wants_write
