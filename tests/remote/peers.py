"""A socket with the keys of a client, which says what it likes."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager

import zmq

from envhub_worker.extras.access.keys import KeyPair
from envhub_worker.protocol import messages as m
from tests.remote.listening import Listening


class Peer:
    """A socket with a key, that says what it likes."""

    def __init__(self, socket: zmq.Socket[bytes]) -> None:
        self.socket = socket
        self.number = 0

    def tell(self, message: m.Message, *payload: bytes) -> None:
        self.number += 1
        self.socket.send_multipart([*m.pack_header(message, self.number), *payload])

    def ask(self, message: m.Message, *payload: bytes) -> m.Message:
        self.tell(message, *payload)
        assert self.socket.poll(60_000)
        return m.unpack_header(self.socket.recv_multipart()[0])[1]

    def refused(self, message: m.Message, *payload: bytes) -> m.Refusal:
        reply = self.ask(message, *payload)
        assert isinstance(reply, m.Refusal), reply
        return reply


@contextmanager
def peer(server: Listening, pair: KeyPair, *, routing_id: bytes = b"") -> Iterator[Peer]:
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.CURVE_SERVERKEY, bytes.fromhex(server.public))
        socket.setsockopt(zmq.CURVE_PUBLICKEY, pair.public)
        socket.setsockopt(zmq.CURVE_SECRETKEY, pair.secret)
        if routing_id:
            socket.setsockopt(zmq.ROUTING_ID, routing_id)
        socket.connect(server.endpoint)
        yield Peer(socket)


def brought(client: Peer, code: bytes) -> str:
    sha256 = hashlib.sha256(code).digest()
    offer = m.OfferSnapshot((("env.py", len(code), sha256),))
    client.ask(offer)
    client.ask(m.PutBlob(sha256, 0), code)
    wanted = client.ask(offer)
    assert not wanted.hashes
    return wanted.snapshot
