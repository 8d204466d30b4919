"""A mistake of the server's own ends nothing, and the operator reads of it."""

import errno
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zmq

from envhub_worker.extras.access.audit.log import Events, Log, json_line
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import RemoteProtocolError
from envhub_worker.server.gate import LocalGate
from envhub_worker.server.server import Server

_PATIENCE_MS = 120_000
LACKS = (
    (OSError(errno.EMFILE, "Too many open files"), "ulimit -n"),
    (zmq.ZMQError(errno.ENFILE), "fs.file-max"),
    (OSError(errno.ENOSPC, "No space left on device", "/state/x"), "df -i"),
    (OSError(errno.EFBIG, "File too large"), "ulimit -f"),
)
"""What a machine has run out of, and what is said of it."""


class Failing(LocalGate):
    """Raises an error for each request, and one at each second."""

    def __init__(self, error: Exception, log: Log) -> None:
        self.error = error
        self.witness = Events(log, lambda key: None, lambda key: None)

    def authorize(self, *request: object) -> m.Message:
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


def test_what_a_request_meets_is_in_the_log() -> None:
    """With the way to it, where it is nothing that a client did; the client is answered. What the
    machine lacks is no mistake: the client reads that it is the server that lacks it, and the
    operator what to do."""
    said = list[str]()
    gate = Failing(RuntimeError("our mistake"), Log(said.append, form=json_line))
    with serving(gate) as endpoint:
        assert "our mistake" in refused(endpoint).message
        [ours] = [line for line in said if '"server_error"' in line]
        assert "our mistake" in ours
        assert "authorize" in ours
        said.clear()
        gate.error = RemoteProtocolError("the client's")
        assert "the client's" in refused(endpoint).message
        for error, cure in LACKS:
            gate.error = error
            answered = refused(endpoint).message
            assert "on the server: " in answered
            assert cure in answered
            [told] = [line for line in said if "out_of_res" in line]
            assert cure in told
            assert "Traceback" not in told
            assert not [line for line in said if "server_error" in line]
            said.clear()


class Ticking(LocalGate):
    """Fails with the clock."""

    def __init__(self, log: Log) -> None:
        self.failed = threading.Event()
        self.witness = Events(log, lambda key: None, lambda key: None)

    def tick(self) -> None:
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
