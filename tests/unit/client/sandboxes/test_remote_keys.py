"""Keys of servers and clients, and the listing of a snapshot that is uploaded."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from envhub_sandbox.errors import PolicyError, SandboxUnavailableError, SnapshotError
from envhub_sandbox.sandboxes import remote_keys, remote_repository
from envhub_worker.access import keys
from envhub_worker.protocol.keys import key_text

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
    with pytest.raises(PolicyError, match="tcp://HOST:PORT"):
        remote_keys.address_of(wrong)
    with pytest.raises(PolicyError, match="leave out the login") as login:
        remote_keys.address_of("tcp://me:secret@host:1")
    assert "secret" not in str(login.value)


def test_a_name_is_no_loopback() -> None:
    assert all(map(remote_keys.is_loopback, ["tcp://127.0.0.2:1", "tcp://[::1]:1"]))
    assert not any(map(remote_keys.is_loopback, ["tcp://localhost:1", "tcp://10.0.0.1:1"]))


def test_a_servers_key_is_given_or_known(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The argument comes before the environment, and that before the file."""
    pairs = [keys.generate() for _ in range(3)]
    texts = [key_text(pair.public) for pair in pairs]
    with pytest.raises(SandboxUnavailableError, match="another program could imitate"):
        remote_keys.server_key(_ENDPOINT, None)
    (config / "known_hosts").write_text(f"other:1 {texts[1]}\nhost:7777 {texts[0]}\n")
    assert remote_keys.server_key(_ENDPOINT, None) == pairs[0].public
    monkeypatch.setenv(remote_keys.SERVER_KEY_VARIABLE, texts[1])
    assert remote_keys.server_key(_ENDPOINT, None) == pairs[1].public
    assert remote_keys.server_key(_ENDPOINT, texts[2]) == pairs[2].public
    with pytest.raises(PolicyError, match="server_key"):
        remote_keys.server_key(_ENDPOINT, "mistyped")


def test_our_key_is_a_text_or_a_file(config: Path) -> None:
    """By default the one that lies where ``keygen`` is advised to write it."""
    with pytest.raises(SandboxUnavailableError, match="keygen"):
        remote_keys.client_key(None)
    pair = keys.generate()
    path, _ = keys.save(pair, config, "client")
    text = path.read_text().strip()
    assert remote_keys.client_key(None) == remote_keys.client_key(path) == pair.secret
    assert remote_keys.client_key(text) == pair.secret
    assert remote_keys.is_key_file(path)
    assert remote_keys.is_key_file(str(path))
    assert not any(map(remote_keys.is_key_file, [None, text, "mistyped"]))


def test_a_listing_names_each_file_once(tmp_path: Path) -> None:
    """By its path, sorted, with its size and hash, however many pieces it has."""
    large = b"x" * (remote_repository.PIECE_BYTES + 1)
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub/b").write_bytes(large)
    (tmp_path / "a").write_bytes(b"")
    found = remote_repository.listing(tmp_path)
    assert [(one.path, one.size) for one in found] == [("a", 0), ("sub/b", len(large))]
    assert [one.sha256 for one in found] == [hashlib.sha256(x).digest() for x in (b"", large)]
    (tmp_path / "gone").symlink_to("nowhere")
    with pytest.raises(SnapshotError, match="cannot be read"):
        remote_repository.listing(tmp_path)
