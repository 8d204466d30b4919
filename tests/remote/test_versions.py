"""Client and worker of different versions of the protocol refuse one another, and say why."""

from pathlib import Path

import pytest

from envhub_sandbox.errors import VersionMismatchError
from envhub_sandbox.sandboxes.process import PROCESS
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.protocol import messages as m
from tests.attacks.client.lying_server import lying

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


def test_a_client_refuses_a_worker_of_another_version() -> None:
    with lying() as server:
        server.lies[m.Hello] = lambda asked: [asked.answer(m.Welcome(ANOTHER, "9.9.9", 4242))]
        client = WorkerConnection(server.endpoint, server.process_fd)
        try:
            text = f"protocol {m.VERSION}, the worker {ANOTHER}: install the same release"
            with pytest.raises(VersionMismatchError, match=text):
                client.hello(Deadline(60))
        finally:
            client.close()
