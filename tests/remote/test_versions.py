"""Client and worker of different versions of the protocol refuse one another, and say why."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zmq

from envhub_sandbox.errors import VersionMismatchError
from envhub_sandbox.sandboxes.process import PROCESS
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.protocol import messages as m

ANOTHER = m.VERSION + 1


@pytest.mark.parametrize("version", [ANOTHER, 0])
def test_a_server_refuses_a_client_of_another_version(tmp_path: Path, version: int) -> None:
    use = PROCESS.acquire(tmp_path)
    server = use.server
    client = WorkerConnection(server.endpoint, server.process_fd)
    try:
        reply, _ = client.request(m.Hello(version, b"x"), deadline=Deadline(60))
    finally:
        client.close()
        use.release()
    assert isinstance(reply, m.Refusal)
    assert reply.error == "VersionMismatchError"
    assert f"protocol {version}, this worker {m.VERSION}" in reply.message


@contextmanager
def worker_of_another_version(tmp_path: Path) -> Iterator[tuple[str, int]]:
    """A worker that welcomes everybody: its endpoint, and a descriptor that never ends."""
    endpoint = f"ipc://{tmp_path}/other"
    context: zmq.Context[Any] = zmq.Context()
    router = context.socket(zmq.ROUTER)
    router.bind(endpoint)
    stop = threading.Event()

    def serve() -> None:
        while not stop.is_set():
            if router.poll(50):
                identity, header = router.recv_multipart()
                number, request = m.unpack_header(header)
                assert isinstance(request, m.Hello)
                reply = m.Welcome(ANOTHER, "9.9.9", 4242)
                router.send_multipart([identity, *m.pack_header(reply, number)])

    thread = threading.Thread(target=serve)
    thread.start()
    never = context.socket(zmq.PAIR)
    try:
        yield endpoint, int(never.getsockopt(zmq.FD))
    finally:
        stop.set()
        thread.join()
        context.destroy(0)


def test_a_client_refuses_a_worker_of_another_version(tmp_path: Path) -> None:
    with worker_of_another_version(tmp_path) as (endpoint, never):
        client = WorkerConnection(endpoint, never)
        try:
            text = f"protocol {m.VERSION}, the worker {ANOTHER}: install the same release"
            with pytest.raises(VersionMismatchError, match=text):
                client.hello(Deadline(60))
        finally:
            client.close()
