"""A client of a server on another host says that it lives, whatever fails meanwhile."""

from __future__ import annotations

import errno
import threading
from typing import Any

import pytest
import zmq

from envhub_sandbox.errors import WorkerTimeoutError
from envhub_sandbox.sandboxes import remote
from envhub_sandbox.transport.tcp import TcpServer
from envhub_worker.protocol import messages as m
from tests.support import inside

FAULTS = (
    zmq.ZMQError(errno.EMFILE),
    WorkerTimeoutError("late"),
    RuntimeError("set changed size during iteration"),
)


@pytest.mark.parametrize("moment", ["connect", "hello", "request", "close"])
def test_the_thread_outlives_every_fault(moment: str, monkeypatch: pytest.MonkeyPatch) -> None:
    left, heard = list(FAULTS), threading.Event()

    def fails(at: str) -> None:
        if left and moment in (at, "close" if at == "request" else at):
            raise left.pop()

    class Connection:
        patience_s = 0.04

        def __init__(self, *_: Any, **__: Any) -> None:
            fails("connect")

        def hello(self, _: object) -> None:
            fails("hello")

        def request(self, message: m.Message, **_: object) -> None:
            fails("request")
            assert isinstance(message, m.KeepAlive)
            heard.set()

        def close(self) -> None:
            if moment == "close":
                raise zmq.ZMQError(errno.ENOTSOCK)

    monkeypatch.setattr(remote, "WorkerConnection", Connection)
    monkeypatch.setattr(*inside.first_keep_alive_s(), 0.01)
    server = remote.RemoteServer("tcp://host:1", TcpServer(None, None))
    assert heard.wait(60)
    assert left == []
    server.stop()
