"""A server on another host that ends handshakes: one that restarts, or one with another key."""

import contextlib
import socket
import threading
from collections.abc import Iterator

import pytest
import zmq
from zmq.utils import z85

from envhub_sandbox.errors import SandboxUnavailableError
from envhub_sandbox.extras.remote.sandbox import RemoteServer
from envhub_sandbox.extras.remote.tcp import TcpLink, TcpServer
from envhub_sandbox.transport.replies import UnreachableError
from tests.support import inside
from tests.support.processes import eventually

_PUBLIC, _SECRET = zmq.curve_keypair()


@contextlib.contextmanager
def linked(port: int, far: TcpServer, **options: int) -> Iterator[TcpLink]:
    with zmq.Context() as context, context.socket(zmq.DEALER) as client:
        client.linger = 0
        endpoint = f"tcp://127.0.0.1:{port}"
        link = TcpLink(client, endpoint, far)
        for name, value in options.items():
            setattr(client, name, value)
        client.connect(endpoint)
        try:
            yield link
        finally:
            link.close()


def hangs_up(listener: socket.socket) -> None:
    """Take one connection, and end it in the midst of the handshake."""
    connection, _ = listener.accept()
    connection.recv(10)
    connection.close()


def test_a_server_that_restarts_is_waited_for() -> None:
    far = TcpServer(_PUBLIC, z85.decode(_SECRET))
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    with linked(port, far) as link, zmq.Context() as context:
        with listener:
            hangs_up(listener)
        with context.socket(zmq.ROUTER) as server:
            server.linger, server.curve_server, server.curve_secretkey = 0, True, _SECRET
            server.bind(f"tcp://127.0.0.1:{port}")
            assert eventually(lambda: link.drain() is None and inside.link_is_up(link))


@pytest.mark.parametrize("keys", [True, False])
def test_who_ends_every_handshake_is_refused(keys: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(*inside.CUT_S, 0.3)
    far = TcpServer(_PUBLIC, z85.decode(_SECRET)) if keys else TcpServer(None, None)
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    hangs_up(listener)

        threading.Thread(target=serve, daemon=True).start()
        with linked(listener.getsockname()[1], far) as link:
            error = UnreachableError if keys else SandboxUnavailableError
            said = "given server_key, or it is restarting" if keys else "both"
            with pytest.raises(error, match=said):
                eventually(lambda: link.drain() is not None)
        listener.shutdown(socket.SHUT_RDWR)


def test_one_that_ends_every_connection_holds_up_no_other() -> None:
    """libzmq has one thread for all of them, which waits for room where nobody reads its news."""
    ended = list[int]()

    def end_all() -> None:
        with contextlib.suppress(OSError):
            while True:
                listener.accept()[0].close()
                ended.append(1)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=end_all, daemon=True).start()
        far = TcpServer(_PUBLIC, z85.decode(_SECRET))
        often = {"reconnect_ivl": 1, "reconnect_ivl_max": 1}
        with linked(listener.getsockname()[1], far, **often) as link:
            is_held_up = not eventually(lambda: len(ended) > 1_500, 240)  # of two events each
            listener.shutdown(socket.SHUT_RDWR)
            while is_held_up and link.monitor.poll(1_000):  # or ``close`` would wait, too
                link.monitor.recv_multipart()
    assert not is_held_up


def test_what_happens_to_a_connection_that_nobody_uses_is_read() -> None:
    """By the thread that says that we live; while an answer is awaited, by its owner alone."""
    far = TcpServer(None, None)
    with zmq.Context() as context, context.socket(zmq.ROUTER) as server:
        server.linger = 0
        port = server.bind_to_random_port("tcp://127.0.0.1")
        with linked(port, far) as idle, linked(port, far) as used:
            used.awaited = {1: "a request"}
            assert eventually(lambda: bool(used.monitor.poll(0)))
            with contextlib.ExitStack() as stack:
                stack.callback(RemoteServer(f"tcp://127.0.0.1:{port}", far).stop)
                assert eventually(lambda: inside.link_is_up(idle))
            assert not inside.link_is_up(used)


def test_what_was_read_of_a_refusal_is_raised_next(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(*inside.CUT_S, 0.0)
    far = TcpServer(None, None)
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        linked(listener.getsockname()[1], far) as link,
    ):
        for _ in range(2):
            hangs_up(listener)
        assert link.monitor.poll(60_000)
        link.read_ahead()
        with (
            zmq.Context() as context,
            context.socket(zmq.PAIR) as silent,
            monkeypatch.context() as patched,
        ):
            # what happens to the connection afterwards is no business of this test
            patched.setattr(link, "monitor", silent)
            with pytest.raises(SandboxUnavailableError, match="both"):
                link.drain()
            link.drain()
