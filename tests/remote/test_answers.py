"""What a server answers to requests that are wrong, and to another version."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest

from envhub_sandbox.errors import VersionMismatchError
from envhub_sandbox.sandboxes.process import PROCESS
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.extras.access import keys
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.limits import DEFAULT_LIMITS
from tests.attacks.client.lying_server import lying
from tests.remote.listening import Listening
from tests.remote.peers import Peer, peer

MIB = 1 << 20


@pytest.fixture
def client(server: Listening) -> Iterator[Peer]:
    """A client that has said Hello, and keeps no rule after that."""
    with peer(server, keys.load(server.state / "client.key")) as found:
        assert isinstance(found.ask(m.Hello(m.VERSION, b"unruly")), m.Welcome)
        yield found


def raw(client: Peer, number: int, *fields: object) -> list[bytes]:
    """A header that no function of ours would write, as it travels."""
    document = msgpack.packb(fields)
    return [number.to_bytes(8, "big") + len(document).to_bytes(4, "little") + document]


def test_what_is_refused_is_named_in_a_few_words(client: Peer, good: Any) -> None:
    """A hash of another length, which would become the name of a file; and no long text is sent
    back whole."""
    for size in (0, 31, 3 * MIB):
        refused = client.refused(m.PutBlob(b"h" * size, 0), b"data")
        assert refused.error == "LocalProtocolError"
        assert len(refused.message) < 10_000
    for request in (
        m.OpenJail("x" * MIB, "", "", "y" * MIB, "env.py", {"profile": "z" * MIB}, 1),
        m.OpenJail("x", "", "", "sha256:" + "y" * MIB, "e/" * MIB, {}, 1),
        m.OfferSnapshot((("p" * MIB, 1, b"h" * 32),)),
        m.OfferSnapshot((("\x1b" * MIB, 1, b"h" * 32),)),
    ):
        assert len(client.refused(request).message) < 10_000


def malformed() -> dict[str, list[object]]:
    """A kind and fields, by what is wrong with them."""
    nested: list[object] = []
    for _ in range(100):
        nested = [nested]
    return {
        "unknown kind": [120],
        "too few fields": [m.PutBlob.kind],
        "too many fields": [m.PutBlob.kind, b"h" * 32, 0, 1, 2, 3],
        "wrong types": [m.PutBlob.kind, "h", "0"],
        "too deep": [m.OfferSnapshot.kind, nested],
        "too many items": [m.OfferSnapshot.kind, list(range(DEFAULT_LIMITS.items + 1))],
        "too long": [m.OfferSnapshot.kind, b"x" * (DEFAULT_LIMITS.header_bytes + 1)],
        "a jail's message": [m.Step.kind],
        "a reply": [m.Done.kind],
    }


def test_a_malformed_request_is_refused(client: Peer, good: Any) -> None:
    """As long as its id can be read there is somebody to tell."""
    for what, fields in malformed().items():
        client.number += 1
        client.socket.send_multipart(raw(client, client.number, *fields))
        assert client.socket.poll(60_000), f"{what}: no answer"
        number, reply = m.unpack_header(client.socket.recv_multipart()[0])
        assert number == client.number, what
        assert isinstance(reply, m.Refusal), what


def test_many_in_a_row_do_not_end_the_server(client: Peer, good: Any, server: Listening) -> None:
    for number in range(120):
        # a few large ones: a server that only decrypts hears of nobody's life
        client.tell(m.PutBlob(b"h" * (2 * MIB + 1 if number < 8 else 3), 0), b"data")
        client.socket.send_multipart([b"\0\0\0\0"])
        client.socket.send_multipart([b"\x80" + bytes(99)])
        client.socket.send_multipart([b""])
    assert isinstance(client.ask(m.GetStatus()), (m.Status, m.Refusal))
    assert server.process.poll() is None
    assert "Traceback" not in server.said()


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
