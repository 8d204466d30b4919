"""The commands of ``envhub-worker``: their options, what they write, and what they refuse."""

from __future__ import annotations

import argparse
import resource
import socket
import stat
from pathlib import Path
from typing import Any

import pytest

from envhub_worker.access import keys
from envhub_worker.cli import drain, http_port, keygen, listen, serve
from envhub_worker.protocol.keys import key_text, parse_key


def parsed(program: Any, *words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    program.add_arguments(parser)
    return parser.parse_args(words)


def test_a_key_pair_is_written_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = parsed(keygen, "--out", str(tmp_path), "--name", "mine")
    assert keygen.run(arguments) == 0
    secret, public = tmp_path / "mine.key", tmp_path / "mine.pub"
    assert stat.S_IMODE(secret.stat().st_mode) == 0o600
    assert key_text(parse_key(public.read_text())) in capsys.readouterr().out
    before = secret.read_bytes()
    assert keygen.run(arguments) == 1
    assert "is not replaced" in capsys.readouterr().err
    assert secret.read_bytes() == before
    assert parse_key(secret.read_text()) != parse_key(public.read_text())


def test_a_folder_that_cannot_be_written_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    assert keygen.run(parsed(keygen, "--out", str(tmp_path / "file" / "below"))) == 1
    assert "envhub-worker keygen: " in capsys.readouterr().err


def test_where_no_server_listens_there_is_nothing_to_drain(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert drain.run(parsed(drain, "--state-dir", str(tmp_path), "--no-wait")) == 1
    assert capsys.readouterr().err.startswith("envhub-worker drain: ")


def test_connections_leave_descriptors_to_jails(monkeypatch: pytest.MonkeyPatch) -> None:
    for soft, most in ((1_000, 500), (100_000, 1_024), (1, 1), (resource.RLIM_INFINITY, 1_024)):
        limits = soft, resource.RLIM_INFINITY
        monkeypatch.setattr(resource, "getrlimit", lambda _, found=limits: found)
        assert listen.most_connections(1_024) == most


def test_a_server_takes_its_options() -> None:
    """Those of ``listen`` have defaults; ``serve`` is started by a client, which names all."""
    assert parsed(listen, "--max-jails", "3").max_jails == 3
    with pytest.raises(SystemExit):
        parsed(serve)


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("9090", ("127.0.0.1", 9090)),
        ("0.0.0.0:0", ("0.0.0.0", 0)),
        ("[::1]:80", ("::1", 80)),
    ],
)
def test_addresses_of_metrics(text: str, address: tuple[str, int]) -> None:
    assert http_port.parse_address(text) == address


@pytest.mark.parametrize("text", ["", "host:80", "1.2.3.4", "127.0.0.1:99999", "127.0.0.1:-1", "٣"])
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"such as 127\.0\.0\.1:9090"):
        http_port.parse_address(text)


def asked(address: str, request: bytes) -> bytes:
    host, _, port = address.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=60) as peer:
        peer.sendall(request)
        return b"".join(iter(lambda: peer.recv(65_536), b""))


def test_a_port_answers_who_asks_and_refuses_the_rest() -> None:
    """By the path; another method, noise and a flood are no question, and end nothing."""

    def echo(path: str) -> http_port.Reply:
        return 200, "text/plain", path.encode()

    port = http_port.HttpPort("127.0.0.1", 0, echo, pytest.fail)
    address = port.address
    try:
        answer = asked(address, b"GET /metrics HTTP/1.1\r\n\r\n")
        assert answer.startswith(b"HTTP/1.1 200")
        assert answer.endswith(b"/metrics")
        for request in (b"POST / HTTP/1.1\r\n\r\n", b"noise\r\n\r\n"):
            assert not asked(address, request).startswith(b"HTTP/1.1 200")
        assert asked(address, b"GET / HTTP/1.0\r\n\r\n").endswith(b"/")
    finally:
        port.close()
    with pytest.raises(OSError, match="refused"):
        asked(address, b"")


def test_generated_keys_differ() -> None:
    assert len({keys.generate().secret for _ in range(10)}) == 10
