"""A client of a server on another host says that it lives, whatever fails meanwhile."""

import contextlib
import errno
import hashlib
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq

from envhub_sandbox import errors
from envhub_sandbox.extras.packages.declared import parse_requirement
from envhub_sandbox.extras.packages.modules import Guess
from envhub_sandbox.extras.packages.packages import PackageSet
from envhub_sandbox.extras.packages.request import PackageRequest
from envhub_sandbox.extras.remote import keys as remote_keys
from envhub_sandbox.extras.remote import repository as remote_repository
from envhub_sandbox.extras.remote import sandbox as remote
from envhub_sandbox.extras.remote.repository import (
    ServerPackages,
    UploadedRepository,
    order_of,
    request_packages,
)
from envhub_sandbox.extras.remote.sandbox import facts_of
from envhub_sandbox.extras.remote.tcp import TcpServer
from envhub_sandbox.hub import store
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_worker.extras.access import keys
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.keys import key_text
from tests.attacks.client.lying_server import Asked, Frames, LyingServer, LyingUse, lying
from tests.support import inside

FAULTS = (
    zmq.ZMQError(errno.EMFILE),
    errors.WorkerTimeoutError("late"),
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
    monkeypatch.setattr(*inside.FIRST_KEEP_ALIVE_S, 0.01)
    server = remote.RemoteServer("tcp://host:1", TcpServer(None, None))
    assert heard.wait(60)
    assert left == []
    server.stop()


# --- Keys of servers and clients, and the listing of a snapshot that is uploaded


_ENDPOINT = "tcp://host:7777"


@pytest.fixture(autouse=True)
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder for keys, and no key in the environment."""
    monkeypatch.setenv(remote_keys.CONFIG_VARIABLE, str(tmp_path))
    for name in (remote_keys.SERVER_KEY_VARIABLE, remote_keys.CLIENT_KEY_VARIABLE):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


@pytest.mark.parametrize(
    "wrong",
    [
        *("host:1", "tcp://host", "tcp://host:x", "ipc://host:1", "tcp://[::1"),
        *("tcp://*:1", "tcp://host:0", "tcp://a b:1", "tcp://h\u00e9:1", "tcp://host:1?x"),
        *("tcp://ho\nst:1", "tcp://ho\0st:1", "tcp://\x1b[2J:1", "TCP://host:1"),
    ],
)
def test_only_host_and_port_are_an_address(wrong: str) -> None:
    assert remote_keys.address_of("tcp://[::1]:80") == "::1:80"
    with pytest.raises(errors.PolicyError, match="tcp://HOST:PORT"):
        remote_keys.address_of(wrong)
    with pytest.raises(errors.PolicyError, match="leave out the login") as login:
        remote_keys.address_of("tcp://me:secret@host:1")
    assert "secret" not in str(login.value)


def test_a_name_is_no_loopback() -> None:
    assert all(map(remote_keys.is_loopback, ["tcp://127.0.0.2:1", "tcp://[::1]:1"]))
    assert not any(map(remote_keys.is_loopback, ["tcp://localhost:1", "tcp://10.0.0.1:1"]))


def test_a_servers_key_is_given_or_known(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The argument comes before the environment, and that before the file."""
    pairs = [keys.generate() for _ in range(3)]
    texts = [key_text(pair.public) for pair in pairs]
    with pytest.raises(errors.SandboxUnavailableError, match="another program could imitate"):
        remote_keys.server_key(_ENDPOINT, None)
    (config / "known_hosts").write_text(f"other:1 {texts[1]}\nhost:7777 {texts[0]}\n")
    assert remote_keys.server_key(_ENDPOINT, None) == pairs[0].public
    monkeypatch.setenv(remote_keys.SERVER_KEY_VARIABLE, texts[1])
    assert remote_keys.server_key(_ENDPOINT, None) == pairs[1].public
    assert remote_keys.server_key(_ENDPOINT, texts[2]) == pairs[2].public
    with pytest.raises(errors.PolicyError, match="server_key"):
        remote_keys.server_key(_ENDPOINT, "mistyped")


def test_our_key_is_a_text_or_a_file(config: Path) -> None:
    with pytest.raises(errors.SandboxUnavailableError, match="keygen"):
        remote_keys.client_key(None)
    pair = keys.generate()
    path, _ = keys.save(pair, config, "client")
    text = path.read_text().strip()
    assert remote_keys.client_key(None) == remote_keys.client_key(path) == pair.secret
    assert remote_keys.client_key(text) == pair.secret
    assert remote_keys.is_key_file(path)
    assert remote_keys.is_key_file(str(path))
    assert not any(map(remote_keys.is_key_file, [None, text, "mistyped"]))


@pytest.mark.parametrize("name", ["client.key", "known_hosts"])
def test_a_file_of_keys_that_cannot_be_read_is_said(config: Path, name: str) -> None:
    def read() -> bytes:
        is_ours = name == "client.key"
        return remote_keys.client_key(None) if is_ours else remote_keys.server_key(_ENDPOINT, None)

    pair = keys.generate()
    line = f"host:7777 {key_text(pair.public)}" if name == "known_hosts" else key_text(pair.secret)
    (config / name).write_bytes(f"\ufeff{line}\n".encode())
    assert read() in (pair.public, pair.secret)
    (config / name).write_bytes(b"\xff\xfe\x00")
    with pytest.raises((errors.PolicyError, errors.SandboxUnavailableError)):
        read()
    with (config / name).open("wb") as file:
        file.truncate(1 << 30)
    with pytest.raises(errors.PolicyError, match="larger than 1 MiB"):
        read()
    (config / name).unlink()
    (config / name).mkdir()
    with pytest.raises(errors.PolicyError, match="Is a directory"):
        read()


def test_a_key_that_was_mistyped_is_not_repeated(config: Path, tmp_path: Path) -> None:
    for wrong in ("nowhere/" + "k" * 33, str(tmp_path / "none.key"), "x" * 41, "a/\0b"):
        with pytest.raises(errors.PolicyError, match="client_key") as caught:
            remote_keys.client_key(wrong)
        assert wrong not in str(caught.value)


def test_a_listing_names_each_file_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The record that says which are programs is believed in the store alone."""
    large = b"x" * (remote_repository.PIECE_BYTES + 1)
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub/b").write_bytes(large)
    (tmp_path / "a").write_bytes(b"")
    found = remote_repository.listing(tmp_path)
    assert [(one.path, one.size) for one in found] == [("a", 0), ("sub/b", len(large))]
    assert [one.sha256 for one in found] == [hashlib.sha256(x).digest() for x in (b"", large)]
    assert [one.executable for one in found] == [False, False]
    # a store on Windows, whose disk has no modes; the record has those of git
    monkeypatch.setenv("ENVHUB_CACHE", str(tmp_path.parent / "cache"))
    tree = store.folder_of("local") / tmp_path.name
    shutil.copytree(tmp_path, tree)
    for root, executable in ((tree, [False, True]), (tmp_path, [False, False])):
        record = '{"programs": ["sub/b"], "endpoint": "https://a.example"}'
        (root.parent / "record.json").write_text(record)
        assert [one.executable for one in remote_repository.listing(root)] == executable
    assert store.endpoint_of(tree) == "https://a.example"
    with pytest.raises(FileNotFoundError):
        store.endpoint_of(tmp_path)
    (tmp_path.parent / "record.json").unlink()
    (tmp_path / "gone").symlink_to("nowhere")
    with pytest.raises(errors.SnapshotError, match="cannot be read"):
        remote_repository.listing(tmp_path)


# --- What a server says of packages that it makes: bounded, of the right types, and asked politely


GUESS = Guess("cv2", parse_requirement("opencv-python", "env.py, line 1"), ())
REQUEST = PackageRequest("org/repo", (parse_requirement("numpy<3", "a.txt"),), guesses=(GUESS,))
FACTS: dict[str, object] = {"lock": "abc", "packages": ("numpy==2.0",)}


@pytest.fixture
def server() -> Iterator[LyingServer]:
    with lying() as found:
        yield found


def says(server: LyingServer, *answers: m.Message) -> None:
    left = list(answers)

    def lie(asked: Asked) -> list[Frames]:
        return [asked.answer(left.pop(0) if len(left) > 1 else left[0])]

    server.lies[m.NeedPackages] = lie


def packages(state: str, name: str = "", progress: str = "", **facts: object) -> m.Packages:
    return m.Packages(state, name, facts, progress)


def make(server: LyingServer, lines: list[str]) -> tuple[PackageSet | None, ServerPackages]:
    """What the server makes; its use is released, whatever it says."""
    use = LyingUse(server)
    target = ServerPackages(lambda: use, {})
    try:
        return target.make(REQUEST, lines.append), target
    finally:
        assert not use.live


def test_it_is_asked_until_they_are_made(server: LyingServer) -> None:
    """Each new line of progress is shown once, without what would paint."""
    inferred = [{"module": "cv2", "requirement": "evil"}, {"module": "never asked"}, "none"]
    half = packages("making", progress="\x1b[2J" + "x" * 900)
    says(server, half, half, packages("made", "k1", inferred=inferred, **FACTS))
    lines: list[str] = []
    made, target = make(server, lines)
    own = {"module": "cv2", "requirement": "opencv-python", "where": "env.py, line 1"}
    assert made.facts == {"lock": "abc", "packages": ["numpy==2.0"], "inferred": [own]}
    assert target.orders == {"k1": order_of(REQUEST)}
    [line] = lines
    assert line.isprintable()
    assert len(line) <= 310


def test_its_own_packages_are_no_set(server: LyingServer) -> None:
    """Nothing is to be handed back; a refusal is raised as what it is."""
    says(server, packages("own"))
    made, target = make(server, [])
    assert (made, target.orders) == (None, {})
    says(server, m.Refusal("DependencyError", "no such version", "", ""))
    with pytest.raises(errors.DependencyError, match="no such version"):
        make(server, [])


@pytest.mark.parametrize(
    "lie",
    [
        packages("ready"),
        packages("made", "", **FACTS),
        packages("made", "../etc", **FACTS),
        packages("made", "k" * 65, **FACTS),
        packages("made", "k1"),
        packages("made", "k1", **{**FACTS, "lock": 7}),
        packages("made", "k1", **{**FACTS, "packages": "numpy"}),
        packages("made", "k1", **{**FACTS, "packages": ("a",) * 10_001}),
        m.Done(),
    ],
)
def test_other_answers_break_the_protocol(server: LyingServer, lie: m.Message) -> None:
    says(server, lie)
    with pytest.raises(errors.RemoteProtocolError):
        make(server, [])


def test_a_server_that_never_ends_is_given_up(server: LyingServer) -> None:
    says(server, packages("making"))
    client = WorkerConnection(server.endpoint, server.process_fd)
    try:
        with pytest.raises(errors.WorkerTimeoutError):
            request_packages(order_of(REQUEST), client, Deadline(0.05))
    finally:
        client.close()


def test_packages_of_a_new_server_shorten_no_start(server: LyingServer, tmp_path: Path) -> None:
    """Two polls take longer than the start may; its time counts from the fork of a jail."""
    half = packages("making")
    says(server, half, half, packages("made", "k1", **FACTS))
    server.lies[m.OfferSnapshot] = lambda asked: [asked.answer(m.MissingBlobs("sent", ()))]
    repository = UploadedRepository(tmp_path, order_of(REQUEST), "k1")
    deadline = Deadline(1.0)
    client = WorkerConnection(server.endpoint, server.process_fd)
    server.uploading = threading.Lock()
    with contextlib.closing(client):
        order = repository.prepare(m.OpenJail("", "", "", "", "", {}, 1), server, client, deadline)
    assert (order.snapshot, order.packages) == ("sent", "k1")
    assert not deadline.passed
    assert deadline.left_s() < 1.0


@pytest.mark.parametrize("given", [{"python": "/usr/bin/python3"}, {"fetch_python": True}])
def test_what_is_of_this_machine_is_not_asked_for(given: dict[str, Any]) -> None:
    with pytest.raises(errors.PolicyError, match="dependencies"):
        order_of(PackageRequest("org/repo", (), **given))


# --- What a server on another host says of itself: its own words, of the types that there are


ANSWER: dict[Any, Any] = {
    "python": "3.12.1", "profile": "strict", "weakest_profile": "no-userns", "network": True,
    "quotas": {"jails": 4}, "clients": {"alice": {"jails": 1}}, "draining_s": None,
}  # fmt: skip


def test_what_it_says_is_kept() -> None:
    """What it may enforce lies between its strongest profile and the weakest that it permits."""
    found = facts_of(m.Welcome(1, "0.1.0", 7), 0.5, ANSWER)
    assert (found.network, found.gpu, found.draining) == (True, False, False)
    assert (found.quotas, found.used) == ({"jails": 4}, {"jails": 1})
    known = [one for one in ("strict", "no-userns", "container", "lax") if found.enforces(one)]
    assert known == ["strict", "no-userns"]


@pytest.mark.parametrize("lie", [3, "text", [], {"a": 1.5, "b": -1, "c": True, "d": 1 << 63}, None])
def test_other_types_are_nothing(lie: object) -> None:
    """Neither numbers that are none, nor words that would paint, nor many of them."""
    found = facts_of(
        m.Welcome(1, "\x1b[2J" * 100, 7), 0.5, dict.fromkeys(ANSWER, lie) | {"python": "\x1b[2J"}
    )
    assert (found.quotas, found.used, found.network) == ({}, {}, False)
    assert found.version.isprintable()
    assert found.python.isprintable()
    assert not found.enforces("strict")
    flood = {"quotas": {str(number): number for number in range(1000)}}
    assert len(facts_of(m.Welcome(1, "0", 7), 0.5, flood).quotas) == 32
