"""What ``envhub-worker listen`` takes: sizes, addresses, and profiles; and what it prints."""

import argparse
import dataclasses
import resource
from pathlib import Path

import pytest

from envhub_worker.extras.access import keys
from envhub_worker.extras.access.commands import http_port, identity, listen, listen_options
from envhub_worker.extras.access.keys import AuthorizedClients
from envhub_worker.extras.access.quotas import Quotas
from envhub_worker.protocol.keys import key_text, parse_key
from tests.support import inside


def parsed(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    listen_options.add_options(parser)
    return parser.parse_args(arguments)


@pytest.mark.parametrize(
    ("text", "size"),
    [("16G", 16 << 30), ("16 GiB", 16 << 30), ("1.5T", 3 << 39), ("512m", 512 << 20), ("16", None)],
)
def test_sizes_have_units(text: str, size: int | None) -> None:
    told = parsed("--max-memory", text, "--max-upload", text)
    assert told.max_memory == (size or 16 << 30)
    assert told.max_upload == (size or 16 << 20)


@pytest.mark.parametrize("text", ["16X", "much", "0", "-1G", ""])
def test_what_is_no_size_is_told_with_units(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        parsed(f"--max-memory={text}")
    said = capsys.readouterr().err
    assert "--max-memory" in said
    assert "size" in said


def test_options_are_those_of_the_quotas() -> None:
    """Who wrote an option down when runners were called hosts is understood, too."""
    told, quotas = parsed("--max-hosts", "3"), Quotas()
    assert told.max_runners == 3
    assert (told.max_memory, told.max_upload) == (quotas.memory_bytes, quotas.upload_bytes)
    assert (told.max_packages, told.max_inflight) == (quotas.packages_bytes, quotas.inflight_bytes)


def test_connections_leave_descriptors_to_jails(monkeypatch: pytest.MonkeyPatch) -> None:
    for soft, most in ((1_000, 500), (100_000, 1_024), (1, 1), (resource.RLIM_INFINITY, 1_024)):
        limits = soft, resource.RLIM_INFINITY
        monkeypatch.setattr(resource, "getrlimit", lambda _, found=limits: found)
        assert listen.most_connections(1_024) == most


@pytest.mark.parametrize(
    ("text", "address"),
    [("9090", ("127.0.0.1", 9090)), ("0.0.0.0:0", ("0.0.0.0", 0)), ("[::1]:80", ("::1", 80))],
)
def test_addresses_of_metrics(text: str, address: tuple[str, int]) -> None:
    assert http_port.parse_address(text) == address


@pytest.mark.parametrize("text", ["", "host:80", "1.2.3.4", "127.0.0.1:99999", "127.0.0.1:-1", "٣"])
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"such as 127\.0\.0\.1:9090"):
        http_port.parse_address(text)


@pytest.mark.parametrize("bind", ["tcp://", "5555", "ipc://x:1", "tcp://127.0.0.1:http"])
def test_only_tcp_addresses_are_bound(bind: str) -> None:
    """Anything else is a mistake; nobody listens on all interfaces without saying so."""
    with pytest.raises(identity.UsageError, match="--bind takes"):
        identity.check_bind(bind, False)
    assert parsed().bind.startswith("tcp://127.0.0.1:")


@pytest.mark.parametrize(("abi", "default"), [(0, "strict"), (1, "container")])
def test_a_container_without_landlock_permits_no_weak_profile_by_itself(
    monkeypatch: pytest.MonkeyPatch, abi: int, default: str
) -> None:
    """A jail of the profile ``container`` is the server's user: it would read every store."""
    monkeypatch.setattr(*inside.CONTAINER_MARKS, ("/",))
    monkeypatch.setattr("envhub_worker.lockdown.mechanisms.landlock.version", lambda: abi)
    assert parsed().weakest_profile == default
    assert ("no jail can be opened" in identity.unusable("container", default)) is (abi == 0)


def test_a_weak_profile_is_for_one_client(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the start, and when the list grows later; with Landlock it may be as long as it likes."""
    one, other = key_text(keys.generate().public), key_text(keys.generate().public)
    path = tmp_path / "clients"
    path.write_text(f"{one}\n{other}\n")
    options = parsed("--weakest-profile", "container", "--authorized-clients", str(path))
    known = identity.Identity(keys.generate(), path)
    monkeypatch.setattr("envhub_worker.lockdown.mechanisms.landlock.version", lambda: 0)
    with pytest.raises(ValueError, match="without Landlock"):
        inside.gate_of(options, tmp_path, known)
    path.write_text(f"{one}\n")
    inside.gate_of(options, tmp_path, known)
    few = AuthorizedClients(path, {}, 1)
    path.write_text(f"{one}\n{other}\n")
    with pytest.raises(ValueError, match="2 clients"):
        few.refresh()
    assert few.name_of(parse_key(other)) is None
    monkeypatch.setattr("envhub_worker.lockdown.mechanisms.landlock.version", lambda: 1)
    inside.gate_of(options, tmp_path, known)


def test_the_line_names_the_profile_where_the_default_cannot_be_had() -> None:
    """In most containers: what is printed must work when it is pasted."""
    known = identity.Identity(keys.generate(), None, keys.generate(), Path("x"), True, "no-userns")
    said = identity.announcement("tcp://0.0.0.0:5555", known)
    assert said.count("policy={'profile': 'no-userns'}") == 2
    assert 'RemoteSandbox("tcp://127.0.0.1:5555"' in said
    strict = dataclasses.replace(known, profile="strict")
    assert "policy=" not in identity.announcement("tcp://127.0.0.1:1", strict)
