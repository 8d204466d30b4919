"""The loop of a runner: a stream of requests, and the doorbell of the lane that it serves."""

from __future__ import annotations

import os
import socket
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import pytest

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.confinement import Confinement
from envhub_worker.protocol.stream import StreamReader, pack_packet
from envhub_worker.runner import runner
from tests.support.processes import eventually


class QuietLane:
    """A lane of which nothing is asked; its doorbell is one end of a socket pair."""

    def __init__(self, number: int) -> None:
        self.number = number
        client, own = socket.socketpair()
        self.client, self.bell = client, own.detach()

    def wake(self, *, alone: bool) -> bool:
        return bool(os.read(self.bell, 8))

    def serve(self) -> bool:
        return False

    def close(self) -> None:
        os.close(self.bell)
        self.bell = -1


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
