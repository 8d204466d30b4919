"""Who has no key, or the wrong one: refused, bounded and logged, while a client's work goes on."""

import contextlib
import ctypes
import errno
import socket
import struct
import time
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import psutil
import pytest
import zmq
from zmq.utils.monitor import parse_monitor_message

from envhub_sandbox import make_env
from envhub_sandbox.errors import PolicyError, SandboxUnavailableError, WorkerError
from envhub_sandbox.extras.remote.tcp import TcpLink
from envhub_worker.extras.access import keys
from envhub_worker.extras.access.audit.log import LINES, PERIOD_S, Log
from envhub_worker.extras.access.curve_port import ConnectionLimiter
from envhub_worker.extras.access.keys import AuthorizedClients
from envhub_worker.extras.access.packages import Packages
from envhub_worker.extras.access.quotas import Permissions, Quotas, Rules
from envhub_worker.extras.access.remote_gate import RemoteGate
from envhub_worker.extras.access.store.uploads import Uploads
from envhub_worker.loop import Loop
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.keys import key_text
from envhub_worker.server.gate import Incoming
from envhub_worker.server.sessions import Sessions
from envhub_worker.supervisor.records import Asker, RefusedError, Witness
from tests.remote.listening import Listening, listening
from tests.remote.peers import peer
from tests.remote.strangers import greeting, knock
from tests.support import inside
from tests.support.processes import eventually
from tests.support.started import started

_MIB = 1 << 20
_PATIENCE_S = 120.0
_GREETING = greeting(b"NULL")


@pytest.mark.short
def test_another_clients_key_is_refused_at_once(server: Listening, repository: Path) -> None:
    """The error names our public key, which the server's operator has to add; so does its log."""
    pair = keys.generate()

    def knocks() -> bool:
        with pytest.raises(SandboxUnavailableError, match=key_text(pair.public)):
            make_env(repository, sandbox=server.sandbox(client_key=key_text(pair.secret)))
        return key_text(pair.public) in server.said()

    # again and again: the log has a few lines a minute, and other tests have refused knocks too
    assert eventually(knocks)


def test_a_refusal_between_looking_and_sending_is_no_wait(
    server: Listening, repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The socket has nowhere to put the request then, and libzmq would wait for that for ever.
    In some of a hundred refusals libzmq goes on taking messages for a connection that it has given
    up; the error is the same, and the next client gets the other kind."""
    whole = TcpLink.next_number
    had_no_room = False

    def slowly(link: TcpLink) -> int:
        nonlocal had_no_room
        monkeypatch.setattr(TcpLink, "next_number", whole)
        had_no_room = eventually(lambda: not inside.can_send(link), 5)
        return 1  # as if it had looked just before

    def is_refused_without_room() -> bool:
        monkeypatch.setattr(TcpLink, "next_number", slowly)
        stranger = server.sandbox(client_key=key_text(keys.generate().secret))
        with pytest.raises(SandboxUnavailableError, match="does not know our key"):
            make_env(repository, sandbox=stranger)
        return had_no_room

    assert eventually(is_refused_without_room, _PATIENCE_S)


def test_another_servers_key_is_refused_at_once(server: Listening, repository: Path) -> None:
    other = key_text(keys.generate().public)
    wrong = server.sandbox(server_key=other)
    with pytest.raises(SandboxUnavailableError, match=r"another public key than the given\s+serv"):
        make_env(repository, sandbox=wrong)
    assert eventually(lambda: "handshake_failed" in server.said())
    with pytest.raises(SandboxUnavailableError, match="does not speak ZeroMQ with CURVE"):
        make_env(repository, sandbox=server.sandbox(server_key=None, insecure_loopback=True))


def test_a_peer_without_keys_hears_nothing(server: Listening) -> None:
    """A plain ZeroMQ socket gets no reply; the control, with keys, does."""
    hello = m.Hello(m.VERSION, b"stranger")
    with zmq.Context() as context, context.socket(zmq.DEALER) as plain:
        plain.setsockopt(zmq.LINGER, 0)
        plain.connect(server.endpoint)
        plain.send_multipart(m.pack_header(hello, 1))
        assert not plain.poll(1_000)
    with peer(server, keys.load(server.state / "client.key")) as known:
        assert isinstance(known.ask(hello), m.Welcome)


def _gate(folder: Path) -> RemoteGate:
    """One with keys and nobody on its list."""
    rules = Rules(
        keys=keys.generate(),
        authorized=AuthorizedClients(None, {}),
        operators=frozenset(),
        quotas=Quotas(),
        permissions=Permissions(),
        idle_s=0,
    )
    gate = RemoteGate(rules, Uploads(folder, Quotas()), Packages(None, Quotas()), Log())
    gate.begin(Sessions(), None)
    return gate


def test_nobody_comes_in_while_nobody_can_be_asked(tmp_path: Path) -> None:
    """Without its handler libzmq refuses whoever has a key of his own; the control answers."""
    for enforced in (True, False):
        gate, pair = _gate(tmp_path), keys.generate()
        with zmq.Context() as context:
            router, client = context.socket(zmq.ROUTER), context.socket(zmq.DEALER)
            gate.secure(router, Loop(Witness().failed))
            gate.close()
            if not enforced:
                router.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 0)
            port = router.bind_to_random_port("tcp://127.0.0.1")
            client.setsockopt(zmq.LINGER, 0)
            client.setsockopt(zmq.CURVE_SERVERKEY, inside.public_key(gate))
            client.setsockopt(zmq.CURVE_SECRETKEY, pair.secret)
            client.setsockopt(zmq.CURVE_PUBLICKEY, pair.public)
            ends = client.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED)
            client.connect(f"tcp://127.0.0.1:{port}")
            assert _handshakes(ends) == ([False] * _REFUSALS if enforced else [True])
            client.disable_monitor()
            client.close()
            router.close(0)


_REFUSALS = 3


def _handshakes(ends: zmq.Socket[bytes]) -> list[bool]:
    """Whether it was let in: once, or in none of several tries.
    A handler's socket is closed by a thread of libzmq's. A handshake that still finds it fails."""
    for _ in range(_REFUSALS):
        assert ends.poll(60_000)
        if parse_monitor_message(ends.recv_multipart())["event"] != zmq.EVENT_DISCONNECTED:
            return [True]
    return [False] * _REFUSALS


def test_a_message_without_a_proved_key_is_refused(tmp_path: Path) -> None:
    """Where keys are needed an empty one is nobody's: neither a session nor a request."""
    gate = _gate(tmp_path)
    with pytest.raises(RefusedError, match="not authorised"):
        gate.greet(Incoming(b"id", b"", []), b"name")
    asker = Asker(b"id", 1, b"x" * 40, b"")
    with pytest.raises(RefusedError, match="not authorised"):
        gate.authorize(asker, m.GetSessions(), ())


def test_a_flood_of_frames_without_keys_costs_no_memory(
    server: Listening, good: Any, tmp_path: Path
) -> None:
    """Endless MORE frames fill the memory of a peer that takes them, as the control does."""
    assert flood(server) < 64 * _MIB
    with listening(tmp_path / "control", "--insecure-loopback") as control:
        assert flood(control) > 128 * _MIB


def flood(server: Listening) -> int:
    """Send 256 MiB of frames that are never the last one; by how much the server grows."""
    before = server.memory()
    frame = b"\x03" + _MIB.to_bytes(8, "big") + bytes(_MIB)
    with knock(server.port) as connection:
        with contextlib.suppress(ConnectionError):
            connection.sendall(_GREETING + b"\x04\x1c\x05READY\x0bSocket-Type\0\0\0\x06DEALER")
            for _ in range(256):
                connection.sendall(frame)
        return server.memory() - before


def test_a_port_scan_is_a_few_lines_in_the_log(server: Listening, good: Any) -> None:
    before, said, began = server.memory(), failures(server), time.monotonic()
    for number in range(300):
        with knock(server.port) as connection, contextlib.suppress(ConnectionError):
            connection.sendall([b"", b"GET / HTTP/1.0\r\n\r\n", bytes(range(256))][number % 3])
    good.call("count")
    assert server.memory() - before < 64 * _MIB
    periods = 2 + int((time.monotonic() - began) / PERIOD_S)  # of which this saw a part
    assert failures(server) - said <= LINES * periods < 300


def failures(server: Listening) -> int:
    return server.said().count("warning handshake_failed")


def may_filter() -> bool:
    """Whether this user may have the kernel drop who knocks: some kernels ask for privilege."""
    program = ctypes.create_string_buffer(struct.pack("=HBBI", 0x06, 0, 0, 0xFFFF))
    with socket.socket() as door:
        try:
            door.setsockopt(socket.SOL_SOCKET, 26, struct.pack("@HP", 1, ctypes.addressof(program)))
        except PermissionError:
            return False
    return True


REASON = "this user may not filter what a TCP socket gets"
needs_a_filter = pytest.mark.skipif(not may_filter(), reason=REASON)


@needs_a_filter
def test_too_many_connections_stay_outside(tmp_path: Path, repository: Path) -> None:
    """Who is in goes on, descriptors are left for jails, and afterwards the door is open again."""
    with (
        listening(tmp_path / "server", "--max-connections", "40") as server,
        make_env(repository, sandbox=server.sandbox()) as suites,
        contextlib.ExitStack() as crowd,
    ):
        suites.env.reset(seed=1)
        for _ in range(400):
            stranger = crowd.enter_context(socket.socket())
            stranger.setblocking(False)
            stranger.connect_ex(("127.0.0.1", server.port))
        assert eventually(lambda: "no more for the moment" in server.said(), _PATIENCE_S)
        assert suites.env.step(np.array([0]))[0].tolist() == [[1.0]]
        assert psutil.Process(server.process.pid).num_fds() < 300
        crowd.close()
        assert eventually(lambda: _gets_in(server, repository), _PATIENCE_S)


def _gets_in(server: Listening, repository: Path) -> bool:
    try:
        with started(repository, n_envs=2, sandbox=server.sandbox()):
            pass
    except SandboxUnavailableError:
        return False
    return True


@needs_a_filter
def test_a_door_that_cannot_be_shut_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a descriptor left the server goes on, says so, and tries again."""
    said = list[str]()
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        doorman = ConnectionLimiter(router, Loop(Witness().failed), Log(said.append), 1)
        router.bind("tcp://127.0.0.1:*")
        for broken in ("os.listdir", "os.dup"):
            with monkeypatch.context() as patch:
                full = OSError(errno.EMFILE, "Too many open files")
                patch.setattr(broken, Mock(side_effect=full))
                inside.happen(doorman, zmq.EVENT_ACCEPTED)
            assert not inside.door_is_shut(doorman)
        assert "and no end" in said[0]
        inside.happen(doorman, zmq.EVENT_ACCEPTED)
        assert inside.door_is_shut(doorman)
        for _ in range(3):
            inside.happen(doorman, zmq.EVENT_DISCONNECTED)
        doorman.tick()
        assert not inside.door_is_shut(doorman)
        doorman.close()


def test_without_keys_it_listens_on_loopback_only(tmp_path: Path, repository: Path) -> None:
    """``--insecure-loopback`` serves on 127.0.0.1, and refuses every other address."""
    with listening(tmp_path / "open", "--insecure-loopback") as open_server:
        sandbox = open_server.sandbox(server_key=None, client_key=None, insecure_loopback=True)
        with started(repository, sandbox=sandbox):
            pass
    for address in ("*", "localhost"):
        with (
            pytest.raises(AssertionError, match="needs a loopback address"),
            listening(tmp_path / "closed", "--insecure-loopback", bind=f"tcp://{address}:*"),
        ):
            pass
    elsewhere = {"endpoint": "tcp://192.0.2.1:5555", "server_key": None}
    with pytest.raises(PolicyError, match="not on a loopback address"):
        open_server.sandbox(**elsewhere, insecure_loopback=True)


def test_a_key_that_is_taken_off_the_list_is_out(tmp_path: Path, repository: Path) -> None:
    """The list is read anew when it changes: also for who is in already."""
    pair, other = keys.generate(), keys.generate()
    authorized = tmp_path / "authorized"
    authorized.write_text(f"# who may come in\n{key_text(pair.public)} alice\n")
    with listening(tmp_path / "server", "--authorized-clients", str(authorized)) as server:
        sandbox = server.sandbox(client_key=key_text(pair.secret))
        with started(repository, sandbox=sandbox) as env:
            assert [one["client"] for one in server.sessions()] == ["alice"]
            authorized.write_text(f"{key_text(other.public)} bob\n")
            assert eventually(lambda: _is_refused(env))
            assert eventually(lambda: server.jails() == 0)
        with pytest.raises(SandboxUnavailableError, match="does not know our key"):
            make_env(repository, n_envs=2, sandbox=sandbox)


def _is_refused(env: Any) -> bool:
    try:
        env.step(np.array([0]))
    except WorkerError as error:
        return "not authorised any more" in str(error)
    return False
