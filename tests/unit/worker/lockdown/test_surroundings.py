"""What the server in a container says of its surroundings."""

from __future__ import annotations

import json
import socket
import threading
from pathlib import Path

import pytest

from envhub_worker.cli import health
from envhub_worker.lockdown import surroundings
from envhub_worker.protocol.messages.surroundings import Surroundings


def layers(*names: str) -> list[dict[str, object]]:
    """What the probe finds where only these layers can be had."""
    every = ["user-namespace", "namespaces", "mount-namespace", "landlock", "seccomp"]
    return [{"layer": name, "available": name in names} for name in every]


@pytest.mark.parametrize(
    ("there", "abi", "expected"),
    [
        (("user-namespace", "namespaces", "mount-namespace", "landlock", "seccomp"), 7, "strict"),
        (("user-namespace", "namespaces", "landlock", "seccomp"), 7, "no-userns"),
        (("landlock", "seccomp"), 3, "no-userns"),
        (("landlock", "seccomp"), 2, "container"),
        (("seccomp",), 0, "container"),
    ],
    ids=["all", "no mounts", "no namespaces", "an old Landlock", "a filter only"],
)
def test_the_strongest_profile_is_the_one_whose_layers_are_there(
    there: tuple[str, ...], abi: int, expected: str
) -> None:
    """A single missing layer costs the profiles that name it."""
    assert surroundings.profiles(layers(*there), abi)[0] == expected


def test_without_a_system_call_filter_there_is_no_profile() -> None:
    """Nothing would keep the stranger from the server."""
    assert surroundings.profiles(layers("user-namespace", "landlock"), 7) == []


def test_limits_are_read_from_either_kind_of_control_group(tmp_path: Path) -> None:
    """Version 2 has one folder, version 1 one for each controller."""
    two, one, none = tmp_path / "two", tmp_path / "one", tmp_path / "none"
    for folder in (two, none, one / "memory", one / "pids", one / "cpu"):
        folder.mkdir(parents=True)
    for name, text in (("memory.max", "1000"), ("pids.max", "7"), ("cpu.max", "150000 100000")):
        (two / name).write_text(text)
    (one / "memory/memory.limit_in_bytes").write_text("1000\n")
    (one / "pids/pids.max").write_text("7\n")
    (one / "cpu/cpu.cfs_quota_us").write_text("150000\n")
    (one / "cpu/cpu.cfs_period_us").write_text("100000\n")
    for root in (two, one):
        assert surroundings.memory_limit(root) == 1000
        assert surroundings.pids_limit(root) == 7
        assert surroundings.cpus_limit(root) == 1.5
    for read in (surroundings.memory_limit, surroundings.pids_limit, surroundings.cpus_limit):
        assert read(none) is None


def test_no_limit_is_not_read_as_one(tmp_path: Path) -> None:
    """Both versions have a word or a number for "none"."""
    for folder in ("two", "one/memory", "one/pids", "one/cpu"):
        (tmp_path / folder).mkdir(parents=True)
    for name, text in (("memory.max", "max"), ("pids.max", "max"), ("cpu.max", "max 100000")):
        (tmp_path / "two" / name).write_text(text)
    (tmp_path / "one/memory/memory.limit_in_bytes").write_text("9223372036854771712")
    (tmp_path / "one/pids/pids.max").write_text("max")
    (tmp_path / "one/cpu/cpu.cfs_quota_us").write_text("-1")
    (tmp_path / "one/cpu/cpu.cfs_period_us").write_text("100000")
    for root in (tmp_path / "two", tmp_path / "one"):
        for read in (surroundings.memory_limit, surroundings.pids_limit, surroundings.cpus_limit):
            assert read(root) is None


def test_the_network_is_what_the_kernel_lists() -> None:
    """Two lines of head, then a device a line."""
    table = "Inter-|   Receive\n face |bytes\n    lo:  0 0\n  eth0: 12 3\n"
    assert surroundings.network_devices(table) == ["lo", "eth0"]


def test_the_announcement_is_one_line_of_json() -> None:
    """The client reads one line and no more, and finds every field in it."""
    said = surroundings.announcement()
    assert "\n" not in said
    assert set(json.loads(said)) == {"envhub-worker", *vars(Surroundings.read(json.loads(said)))}


@pytest.mark.parametrize(("greeting", "healthy"), [(b"\xff", True), (b"H", False), (b"", False)])
def test_health_is_a_peer_that_speaks_zeromq(greeting: bytes, healthy: bool) -> None:
    """Anything else on the port, or silence, is not the worker."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def greet() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.sendall(greeting)

        thread = threading.Thread(target=greet)
        thread.start()
        assert health.answers("127.0.0.1", listener.getsockname()[1]) is healthy
        thread.join()


def test_nobody_there_is_not_healthy() -> None:
    """A port that refuses."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    assert not health.answers("127.0.0.1", port)
