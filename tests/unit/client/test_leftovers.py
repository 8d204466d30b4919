"""What ``envhub gc`` takes for left behind, and what it leaves alone."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from envhub_sandbox.sandboxes.docker import prune
from envhub_sandbox.sandboxes.docker.run_arguments import CLIENT_LABEL, USER_LABEL
from envhub_sandbox.sandboxes.owner import identity_of


@pytest.fixture(scope="module")
def dead() -> str:
    """The identity of a process that has ended."""
    child = subprocess.Popen([sys.executable, "-S", "-c", "input()"], stdin=subprocess.PIPE)
    name = identity_of(child.pid)
    child.communicate()
    return name


def folder(root: Path, name: str, files: dict[str, str], mode: int = 0o700) -> Path:
    """A folder with files in it."""
    path = root / name
    path.mkdir()
    for file, text in files.items():
        (path / file).write_text(text)
    path.chmod(mode)
    return path


def found(root: Path) -> set[str]:
    """Names of the folders that would be removed."""
    return {Path(one.name).name for one in prune.stale_folders(root)}


def bound(path: Path) -> socket.socket:
    """A socket of a server's kind."""
    made = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    made.bind(str(path))
    made.listen()
    return made


def test_a_containers_folder_is_left_behind_when_its_client_is(tmp_path: Path, dead: str) -> None:
    """By the identity in it; without one nothing can be told."""
    alive = identity_of(os.getpid())
    folder(tmp_path, "envhub-docker-dead0000", {"client": dead})
    folder(tmp_path, "envhub-docker-alive000", {"client": alive})
    folder(tmp_path, "envhub-docker-nothing0", {})
    folder(tmp_path, "envhub-docker-nonsense", {"client": "?"})
    folder(tmp_path, "envhub-docker-not-ours-at-all", {"client": dead})
    folder(tmp_path, "envhub-docker-open0000", {"client": dead}, mode=0o755)
    assert found(tmp_path) == {"envhub-docker-dead0000"}


@pytest.fixture
def short() -> Iterator[Path]:
    """A folder with a name that a socket's may begin with, wherever temporary files go."""
    with tempfile.TemporaryDirectory(prefix="envhub-test-", dir="/tmp") as folder:
        yield Path(folder)


def test_a_servers_folder_is_left_behind_when_nobody_listens(short: Path) -> None:
    """At the socket in it; one that is only being made has none yet."""
    for name in ("listens0", "deserted", "starting", "no_log00"):
        log = {} if name == "no_log00" else {"server.log": ""}
        folder(short, f"envhub-{name}", log)
    with bound(short / "envhub-listens0" / "fds"):
        for name in ("deserted", "no_log00"):
            bound(short / f"envhub-{name}" / "fds").close()
        assert found(short) == {"envhub-deserted"}


def test_a_link_is_not_followed(tmp_path: Path, dead: str) -> None:
    """A name in a folder that everybody may write proves nothing."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    folder(elsewhere, "data", {"client": dead})
    (tmp_path / "envhub-docker-link0000").symlink_to(elsewhere / "data")
    assert found(tmp_path) == set()


def test_removing_removes_the_folder_and_nothing_beside(tmp_path: Path, dead: str) -> None:
    """And says that it did."""
    folder(tmp_path, "envhub-docker-dead0000", {"client": dead, "seccomp.json": "{}"})
    beside = folder(tmp_path, "envhub-docker-alive000", {"client": identity_of(os.getpid())})
    [one] = prune.stale_folders(tmp_path)
    assert one.remove()
    assert list(tmp_path.iterdir()) == [beside]


def test_control_groups_of_ended_servers_are_left_behind(tmp_path: Path, dead: str) -> None:
    """By the pid in the name; those of others have other names."""
    pid = dead.partition(":")[0]
    names = {f"memory/envhub-{pid}-zygote-1", f"envhub-{os.getpid()}-zygote-1", "envhub-x-y"}
    for name in names | {f"user-{pid}-zygote-1"}:
        (tmp_path / name / "jail-1").mkdir(parents=True)
    groups = list(prune.stale_groups(tmp_path))
    assert [Path(one.name).name for one in groups] == [f"envhub-{pid}-zygote-1"]
    assert groups[0].remove()
    assert not Path(groups[0].name).exists()
    assert (tmp_path / f"envhub-{os.getpid()}-zygote-1" / "jail-1").exists()


class OneContainer:
    """An engine with one container of our user's."""

    def __init__(self, client: str, status: str) -> None:
        labels = {CLIENT_LABEL: client, USER_LABEL: str(os.geteuid())}
        self.said = {"Name": "/it", "Config": {"Labels": labels}, "State": {"Status": status}}

    def run(self, command: str, *_: str) -> str:
        """What ``ps`` and ``inspect`` print."""
        return "id" if command == "ps" else json.dumps([self.said])


@pytest.mark.parametrize(
    ("boot", "status", "stale"),
    [
        ("", "running", True),
        ("", "exited", True),
        ("another", "running", False),
        ("another", "created", False),
        ("another", "paused", False),
        ("another", "exited", True),
    ],
)
def test_what_runs_for_a_client_of_another_machine_is_left_alone(
    dead: str, boot: str, status: str, stale: bool
) -> None:
    """An engine may be reached from many machines: whether their processes live nobody knows."""
    pid, start, ours, namespace = dead.split(":")
    engine: Any = OneContainer(":".join([pid, start, boot or ours, namespace]), status)
    assert [one.name for one in prune.stale_containers(engine)] == ["it"] * stale
