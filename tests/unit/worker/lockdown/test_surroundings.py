"""What the server in a container says of its surroundings."""

import json
import socket
import threading
from pathlib import Path

import pytest

from envhub_worker.extras import surroundings
from envhub_worker.extras.access.commands import health
from envhub_worker.protocol.confinement import Surroundings
from envhub_worker.protocol.runtime import OWN, Runtime


def layers(*names: str) -> list[dict[str, object]]:
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
        (("user-namespace", "landlock"), 7, None),
    ],
    ids=["all", "no mounts", "no namespaces", "an old Landlock", "a filter only", "no filter"],
)
def test_the_strongest_profile_is_the_one_whose_layers_are_there(
    there: tuple[str, ...], abi: int, expected: str | None
) -> None:
    assert next(iter(surroundings.profiles(layers(*there), abi)), None) == expected


@pytest.mark.parametrize(
    ("memory", "pids", "cpus", "quota", "found"),
    [
        ("1000", "7", "150000 100000", "150000", (1000, 7, 1.5)),
        ("max", "max", "max 100000", "-1", (None, None, None)),
    ],
    ids=["limits", "none"],
)
def test_limits_are_read_from_either_kind_of_control_group(
    tmp_path: Path, memory: str, pids: str, cpus: str, quota: str, found: object
) -> None:
    """Version 2 has one folder, version 1 one for each controller; for none a word or a number."""
    files: dict[str, dict[str, str]] = {
        "two": {"memory.max": memory, "pids.max": pids, "cpu.max": cpus},
        "one": {
            "memory/memory.limit_in_bytes": memory.replace("max", "9223372036854771712"),
            "pids/pids.max": pids,
            "cpu/cpu.cfs_quota_us": quota,
            "cpu/cpu.cfs_period_us": "100000",
        },
        "empty": {},
    }
    for root, expected in (("two", found), ("one", found), ("empty", (None, None, None))):
        folder = tmp_path / root
        folder.mkdir()
        for name, text in files[root].items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(f"{text}\n")
        readers = surroundings.memory_limit, surroundings.pids_limit, surroundings.cpus_limit
        assert tuple(read(folder) for read in readers) == expected


def test_the_network_is_what_the_kernel_lists() -> None:
    table = "Inter-|   Receive\n face |bytes\n    lo:  0 0\n  eth0: 12 3\n"
    assert surroundings.network_devices(table) == ["lo", "eth0"]


def test_the_announcement_is_one_line_of_json() -> None:
    said = surroundings.announcement(surroundings.measure(), server_key="00")
    assert "\n" not in said
    found = vars(Surroundings.read(json.loads(said)))
    assert set(json.loads(said)) == {"envhub-worker", "server_key", *found}


def test_a_derived_image_brings_its_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of servers for clients on other hosts, too, who cannot name one; else it is the server's."""
    monkeypatch.setattr(surroundings, "ENVIRONMENT", tmp_path / "python")
    assert surroundings.own_runtime() == OWN
    (tmp_path / "python").touch()
    assert surroundings.own_runtime() == Runtime(str(tmp_path / "python"))


@pytest.mark.parametrize(("greeting", "healthy"), [(b"\xff", True), (b"H", False), (b"", False)])
def test_health_is_a_peer_that_speaks_zeromq(greeting: bytes, healthy: bool) -> None:
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
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    assert not health.answers("127.0.0.1", port)
