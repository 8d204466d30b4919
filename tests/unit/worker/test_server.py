"""A mistake of the server's own ends nothing, and the operator reads of it."""

from __future__ import annotations

import errno
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zmq

from envhub_worker.access.audit.events import Events
from envhub_worker.access.audit.log import Log, json_line
from envhub_worker.access.gate import ClientRequest, LocalGate
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.server import Server

_PATIENCE_MS = 120_000


class Failing(LocalGate):
    """Raises an error for each request, and one at each second."""

    def __init__(self, error: Exception, log: Log) -> None:
        self.error = error
        self.witness = Events(log, lambda key: None, lambda key: None)

    def authorize(self, asked: ClientRequest) -> m.Message:
        raise self.error


@contextmanager
def serving(gate: LocalGate) -> Iterator[str]:
    """Where a server listens, in a thread of ours; it removes its folder itself."""
    server = Server("tcp://127.0.0.1:*", Path(tempfile.mkdtemp(dir="/tmp")), [], gate=gate)
    endpoint = server.endpoint  # its socket is the thread's from then on
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        yield endpoint
    finally:
        server.stop()
        thread.join()


def refused(endpoint: str) -> m.Refusal:
    with zmq.Context() as context, context.socket(zmq.DEALER) as peer:
        peer.setsockopt(zmq.LINGER, 0)
        peer.connect(endpoint)
        for number, request in enumerate((m.Hello(m.VERSION, b"me"), m.GetStatus()), 1):
            peer.send_multipart(m.pack_header(request, number))
            assert peer.poll(_PATIENCE_MS)
            _, reply = m.unpack_header(peer.recv_multipart()[0])
    assert isinstance(reply, m.Refusal)
    return reply


@pytest.mark.parametrize(
    ("error", "noted"),
    [(RuntimeError("our mistake"), True), (RemoteProtocolError("the client's"), False)],
)
def test_what_a_request_meets_is_in_the_log(error: Exception, noted: bool) -> None:
    """With the way to it, where it is nothing that a client did; the client is answered."""
    said = list[str]()
    gate = Failing(error, Log(said.append, form=json_line))
    with serving(gate) as endpoint:
        assert str(error) in refused(endpoint).message
    ours = [line for line in said if '"server_error"' in line]
    assert bool(ours) is noted
    assert all("our mistake" in line and "authorize" in line for line in ours)


@pytest.mark.parametrize(
    ("error", "cure"),
    [
        (OSError(errno.EMFILE, "Too many open files"), "ulimit -n"),
        (zmq.ZMQError(errno.ENFILE), "fs.file-max"),
        (OSError(errno.ENOSPC, "No space left on device", "/state/x"), "df -i"),
        (OSError(errno.EFBIG, "File too large"), "ulimit -f"),
    ],
)
def test_what_the_machine_lacks_is_no_mistake(error: Exception, cure: str) -> None:
    """The client reads that it is the server that lacks it, and the operator what to do."""
    said = list[str]()
    gate = Failing(error, Log(said.append, form=json_line))
    with serving(gate) as endpoint:
        answered = refused(endpoint)
    assert "on the server: " in answered.message
    assert cure in answered.message
    assert [cure in line and "Traceback" not in line for line in said if "out_of_res" in line]
    assert not [line for line in said if "server_error" in line]


class Ticking(LocalGate):
    """Fails with the clock."""

    def __init__(self, log: Log) -> None:
        self.failed = threading.Event()
        self.witness = Events(log, lambda key: None, lambda key: None)

    def tick(self, sessions: object, jails: object) -> None:
        if self.failed.is_set():
            return
        self.failed.set()
        raise RuntimeError("late")


def test_what_the_loop_meets_is_in_the_log_too(capfd: pytest.CaptureFixture[str]) -> None:
    said = list[str]()
    gate = Ticking(Log(said.append, form=json_line))
    with serving(gate):
        assert gate.failed.wait(_PATIENCE_MS / 1000)
    assert any('"server_error"' in line and "late" in line for line in said)
    assert "Traceback" not in capfd.readouterr().err
