"""An old client and a new worker, and the other way round: they work, or say what to upgrade."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import zmq

from envhub_sandbox import make_env
from envhub_sandbox.errors import RemoteEnvWarning, VersionMismatchError
from envhub_sandbox.sandboxes.process import PROCESS
from envhub_sandbox.transport.connection import WorkerClient
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.tcp import Far
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.inert import RemoteObject
from envhub_worker.protocol.messages import warned
from tests.support.repositories import CARTPOLES, write_repository
from tests.support.samples import SAMPLES

# Taken from version 1 as it was released; never to be written anew.
HELLO_OF_1 = bytes.fromhex("170000009501070101c410000102030405060708090a0b0c0d0e0f")
WELCOME_OF_1 = bytes.fromhex("0d00000095020701a5302e312e30cd1092")
FAR_FUTURE = m.VERSION + 1


def test_the_pinned_bytes_are_those_of_version_1() -> None:
    """What the code of today reads in them."""
    assert m.unpack([HELLO_OF_1]) == (7, m.Hello(1, 1, bytes(range(16))))
    assert m.unpack([WELCOME_OF_1]) == (7, m.Welcome(1, "0.1.0", 4242))


def test_a_client_of_version_1_is_welcome(tmp_path: Path) -> None:
    """The worker of today answers it in its own version."""
    use = PROCESS.acquire(tmp_path)
    server = use.shared
    try:
        with zmq.Context() as context, context.socket(zmq.DEALER) as old:
            old.setsockopt(zmq.LINGER, 0)
            old.connect(server.endpoint)
            old.send(HELLO_OF_1)
            assert old.poll(30_000)
            request_id, welcome = m.unpack(old.recv_multipart())
    finally:
        use.release()
    assert request_id == 7
    assert isinstance(welcome, m.Welcome)
    assert welcome.version == 1


@pytest.mark.parametrize(
    ("oldest", "newest", "upgrade"),
    [(FAR_FUTURE, FAR_FUTURE, "upgrade the worker"), (0, 0, "upgrade the client")],
)
def test_a_client_that_shares_no_version_hears_whom_to_upgrade(
    tmp_path: Path, oldest: int, newest: int, upgrade: str
) -> None:
    """Too new, or too old."""
    use = PROCESS.acquire(tmp_path)
    server = use.shared
    client = WorkerClient(server.endpoint, server.process_fd)
    try:
        reply, _ = client.request(m.Hello(oldest, newest, b"x"), deadline=Deadline(30))
    finally:
        client.close()
        use.release()
    assert isinstance(reply, m.Refused)
    assert reply.error == "VersionMismatchError"
    assert upgrade in reply.message


@pytest.mark.parametrize(("version", "kind"), [(5, RemoteObject), (m.VERSION, gym.Space)])
def test_an_older_client_is_sent_texts(
    monkeypatch: pytest.MonkeyPatch, version: int, kind: type
) -> None:
    """What it could not read is a description in words, as it was before."""
    monkeypatch.setattr(m, "VERSION", version)
    with make_env(str(SAMPLES / "counter"), n_envs=2) as suites:
        suites.env.reset(seed=0)
        found = suites.env.get_attr("action_space")[0]
        assert isinstance(found, kind)


@pytest.mark.parametrize("version", [warned.FIRST_VERSION - 1, warned.FIRST_VERSION])
def test_an_older_client_is_sent_no_warnings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: int
) -> None:
    """It would take them for a reply; a newer one is told."""
    monkeypatch.setattr(m, "VERSION", version)
    text = CARTPOLES + "import warnings\ndef make_env(n_envs=1, use_async_envs=False):\n"
    text += "    warnings.warn('made')\n    return cartpoles(n_envs)\n"
    folder = write_repository(tmp_path / "warner", text)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        with make_env(str(folder), n_envs=2) as suites:
            assert suites.env.reset(seed=0)[0].shape == (2, 4)
    found = [one.message.text for one in told if isinstance(one.message, RemoteEnvWarning)]
    assert found == (["made"] if version >= warned.FIRST_VERSION else [])


def test_a_client_with_its_ids_inside_is_served(monkeypatch: pytest.MonkeyPatch) -> None:
    """Up to version 7 they were the second item of each message: so it asks, and so it is told."""
    monkeypatch.setattr(m, "VERSION", m.FIRST_NUMBERED_VERSION - 1)
    asked: list[bool] = []
    pack = m.pack_header

    def noted(message: m.Message, number: int, *, numbered: bool) -> list[Any]:
        asked.append(numbered)
        return pack(message, number, numbered=numbered)

    monkeypatch.setattr(m, "pack_header", noted)
    with make_env(str(SAMPLES / "counter"), n_envs=2, lane="frames") as suites:
        suites.env.reset(seed=1)
        suites.env.step(suites.env.action_space.sample())
    assert set(asked) == {False}


@contextmanager
def worker_of_version_1(tmp_path: Path) -> Iterator[tuple[str, int]]:
    """A worker that knows only version 1: its endpoint, and a descriptor that never ends."""
    endpoint = f"ipc://{tmp_path}/old"
    context: zmq.Context[Any] = zmq.Context()
    router = context.socket(zmq.ROUTER)
    router.bind(endpoint)
    stop = threading.Event()

    def serve() -> None:
        while not stop.is_set():
            if router.poll(50):
                identity, header = router.recv_multipart()
                request_id, request = m.unpack([header])  # it knows of no numbered headers
                reply: m.Message = m.Status(())
                if isinstance(request, m.Hello):
                    assert request.oldest == 1  # a worker of version 1 compares only with that
                    reply = m.Welcome(1, "0.1.0", 4242)
                router.send_multipart([identity, *m.pack(reply, request_id)])

    thread = threading.Thread(target=serve)
    thread.start()
    never = context.socket(zmq.PAIR)
    try:
        yield endpoint, int(never.getsockopt(zmq.FD))
    finally:
        stop.set()
        thread.join()
        context.destroy(0)


def test_a_worker_of_version_1_is_understood(tmp_path: Path) -> None:
    """A client of today works with it; what it cannot do is said before it is sent."""
    with worker_of_version_1(tmp_path) as (endpoint, never):
        client = WorkerClient(endpoint, never)
        try:
            assert client.hello(Deadline(30)).version == 1
            assert client.request(m.GetStatus(), deadline=Deadline(30)) == (m.Status(()), [])
            with pytest.raises(VersionMismatchError, match="KeepJail needs 2: upgrade it"):
                client.send(m.KeepJail(1))
        finally:
            client.close()


def test_a_worker_of_version_1_cannot_be_on_another_host(tmp_path: Path) -> None:
    """It knows of no keys; the error says what to upgrade."""
    with worker_of_version_1(tmp_path) as (endpoint, never):
        client = WorkerClient(endpoint, never, far=Far(None, None))
        try:
            with pytest.raises(VersionMismatchError, match="upgrade the worker"):
                client.hello(Deadline(30))
        finally:
            client.close()
