"""A server that is our child: it ends with what was started for it, however its start went."""

import errno
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from envhub_sandbox.errors import SandboxUnavailableError, WorkerStartupError
from envhub_sandbox.extras.docker import leftovers
from envhub_sandbox.extras.docker.run_arguments import FOLDER_LABEL, USER_LABEL
from envhub_sandbox.sandboxes import process
from envhub_sandbox.system.locks import LifeLock
from envhub_sandbox.system.platform import has_ended
from envhub_worker.lockdown.limits.cgroups import Hierarchy, Tree
from envhub_worker.lockdown.mechanisms.locked_folder import LockedFolder, remove_deserted
from tests.support.processes import eventually

DEAF = "import os, signal; signal.signal(15, signal.SIG_IGN); os.close(1); os.read(0, 1)"


@pytest.fixture
def server() -> Iterator[process.LocalServer]:
    made = process.LocalServer(process.SERVER, "", 0.2)
    yield made
    made.stop()


def sleeping(ready: int) -> subprocess.Popen[bytes]:
    os.write(ready, b"1")
    return subprocess.Popen(["sleep", "1000"])


def listen(path: str) -> socket.socket:
    found = socket.socket(socket.AF_UNIX)
    found.bind(path)
    return found


def test_it_runs_while_it_can_be_reached(server: process.LocalServer) -> None:
    """Its process lives, and both sockets are there: a cleaner may have removed them."""
    with server.starting(sleeping) as ready:
        assert os.read(ready, 1) == b"1"
        assert os.read(ready, 1) == b"", "our own copy of its end is closed"
    assert not server.runs
    with listen(server.endpoint.removeprefix("ipc://")), listen(server.fd_path):
        assert server.runs
        os.unlink(server.fd_path)
        assert not server.runs
        with listen(server.fd_path):
            assert server.runs
            os.kill(server.process.pid, signal.SIGKILL)
            assert eventually(lambda: not server.runs)


def test_stop_leaves_nothing(server: process.LocalServer) -> None:
    """Neither the process, nor the folder, nor a descriptor; a second one closes nothing else."""
    with server.starting(sleeping):
        assert server.folder.stat().st_mode & 0o777 == 0o700
    fd = server.process_fd
    server.stop()
    assert server.process.returncode == -signal.SIGTERM
    assert not server.folder.exists()
    os.dup2(2, fd)  # the number is another's now
    try:
        server.stop()
        os.fstat(fd)
    finally:
        os.close(fd)


def test_one_that_does_not_end_is_killed(
    server: process.LocalServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its end is waited for, and not looked for now and then, as ``Popen.wait`` would."""
    started = [sys.executable, "-c", DEAF]
    child = subprocess.Popen(started, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    with child.stdin, child.stdout, server.starting(lambda _: child):
        assert child.stdout.read() == b"", "it ignores SIGTERM from now on"
        monkeypatch.setattr("time.sleep", lambda seconds: pytest.fail("it looks now and then"))
        server.stop()
        assert child.returncode == -signal.SIGKILL


def test_what_fails_in_its_start_ends_it(server: process.LocalServer) -> None:
    with pytest.raises(KeyboardInterrupt), server.starting(sleeping):
        raise KeyboardInterrupt
    assert has_ended(server.process.pid)
    assert (server.stopped, server.folder.exists()) == (True, False)

    def fails(ready: int) -> subprocess.Popen[bytes]:
        raise FileNotFoundError("no interpreter")

    second = process.LocalServer(process.SERVER, "", 0.2)
    with pytest.raises(FileNotFoundError), second.starting(fails):
        pass
    assert (second.stopped, second.folder.exists()) == (True, False)


@pytest.mark.parametrize(
    ("kind", "name", "error"),
    [
        (subprocess.Popen, "__init__", BlockingIOError(errno.EAGAIN, "no process")),
        (threading.Thread, "start", RuntimeError("can't start new thread")),
    ],
)
def test_a_limit_on_processes_and_threads_is_named(
    kind: type, name: str, error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kind, name, Mock(side_effect=error))
    with pytest.raises(WorkerStartupError, match="ulimit -u"):
        process.PROCESS.acquire(tmp_path)


def test_a_fork_of_its_owner_ends_nothing(server: process.LocalServer) -> None:
    with server.starting(sleeping):
        pass
    child = os.fork()
    if child == 0:
        try:
            server.stop()
        finally:
            os._exit(0)
    os.waitpid(child, 0)
    assert server.process.poll() is None
    assert server.folder.exists()


# --- What ``envhub cache gc`` takes for left behind, and what it leaves alone


def folder(root: Path, name: str, files: dict[str, str], mode: int = 0o700) -> Path:
    path = root / name
    path.mkdir()
    for file, text in files.items():
        (path / file).write_text(text)
    path.chmod(mode)
    return path


def found(root: Path) -> set[str]:
    return {path.name for path in process.stale_folders(root)}


def alive(root: Path, name: str) -> Path:
    """A folder of a client that lives: this process."""
    path = folder(root, name, {})
    locks.append(LifeLock(path / "alive"))
    return path


locks: list[LifeLock] = []


def test_a_folder_is_left_with_its_client(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No process holds the lock of its client; without one nothing can be told. A name in a folder
    that everybody may write proves nothing: no link is followed."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    folder(elsewhere, "data", {"alive": ""})
    (tmp_path / "envhub-docker-link0000").symlink_to(elsewhere / "data")
    folder(tmp_path, "envhub-docker-dead0000", {"alive": "", "seccomp.json": "{}"})
    alive(tmp_path, "envhub-docker-alive000")
    folder(tmp_path, "envhub-docker-nothing0", {})
    folder(tmp_path, "envhub-docker-not-ours-at-all", {"alive": ""})
    folder(tmp_path, "envhub-docker-open0000", {"alive": ""}, mode=0o755)
    there = set(tmp_path.iterdir())
    [path] = process.stale_folders(tmp_path)
    assert path.name == "envhub-docker-dead0000"
    with monkeypatch.context() as patch:
        patch.setattr("envhub_sandbox.sandboxes.process.user_id", lambda: os.geteuid() + 1)
        assert found(tmp_path) == set()  # nor is what belongs to another user
    assert leftovers.Leftover("folder", str(path)).remove()
    assert set(tmp_path.iterdir()) == there - {path}


def test_a_servers_folder_is_left_behind_when_nobody_holds_its_lock(tmp_path: Path) -> None:
    """One without a client of its own; a lock is given back by the kernel, whoever ended it."""
    held = LockedFolder("envhub-", tmp_path)
    apart = LockedFolder("envhub-scratch-", tmp_path)
    apart.path.chmod(0o711)
    folder(tmp_path, "envhub-deserted", {"lock": ""})
    folder(tmp_path, "envhub-strangers-too", {"lock": ""})
    folder(tmp_path, "envhub-scratch-deserted", {"lock": ""}, mode=0o711)
    both = {"envhub-deserted", "envhub-scratch-deserted"}
    assert found(tmp_path) == both
    remove_deserted(tmp_path)
    assert held.path.is_dir()
    assert not (tmp_path / "envhub-deserted").exists()
    for one in (held, apart):
        one.remove()
    assert [path.name for path in tmp_path.iterdir()] == ["envhub-strangers-too"]


def test_a_folder_without_a_word_is_left_behind_once_it_is_old(tmp_path: Path) -> None:
    """Its client was killed before it had its lock; one that is new may be about to."""
    for name, files in (("empty000", {}), ("begun000", {".alive": ""}), ("full0000", {"x": ""})):
        folder(tmp_path, f"envhub-{name}", files)
    assert found(tmp_path) == set()
    for path in tmp_path.iterdir():
        os.utime(path, (0, 0))
    assert found(tmp_path) == {"envhub-empty000", "envhub-begun000"}


def test_others_are_removed_by_hand_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A start removes what this machine has left since it runs; ``gc`` finds the other, too."""
    boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    folder(tmp_path, "envhub-dead0000", {"alive": f"{boot} 7"})
    folder(tmp_path, "envhub-another0", {"alive": "another 7"})
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("envhub_sandbox.sandboxes.process.places", lambda: [tmp_path])
    assert found(tmp_path) == {"envhub-dead0000", "envhub-another0"}
    assert [path.name for path in process.remove_stale()] == ["envhub-dead0000"]
    assert [path.name for path in tmp_path.iterdir()] == ["envhub-another0"]


def test_a_path_for_sockets_is_short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    long = tmp_path / ("x" * 100)
    long.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(long))
    made = process.RuntimeFolder(process.CONTAINER)
    try:
        assert len(os.fsencode(made.path / "sockets" / "server")) <= 107
        assert made.path.stat().st_mode & 0o777 == 0o700
        assert made.path.parent in process.places()
        assert process.is_in_use(made.path)
    finally:
        made.remove()
    assert not made.path.exists()
    monkeypatch.setattr("envhub_sandbox.sandboxes.process.places", lambda: [long])
    with pytest.raises(SandboxUnavailableError, match="set TMPDIR to a shorter path"):
        process.RuntimeFolder(process.SERVER)


def test_control_groups_of_ended_servers_are_left_behind(tmp_path: Path) -> None:
    """No process holds their lock, and none is in them; those of others have other names."""
    living = Tree(Hierarchy("cgroup-v1", (str(tmp_path),)), "zygote-1")
    for name in ("memory/envhub_1_zygote-1", "envhub_1_leaf", "envhub_x_y", "user_1_zygote-1"):
        (tmp_path / name / "jail-1").mkdir(parents=True)
    (tmp_path / "envhub_1_leaf" / "cgroup.procs").write_text("7\n")
    groups = list(leftovers.stale_groups(tmp_path))
    assert [Path(one.name).name for one in groups] == ["envhub_1_zygote-1"]
    assert groups[0].remove()
    assert not Path(groups[0].name).exists()
    [mine] = tmp_path.glob("envhub_*_zygote-1")
    assert not leftovers.Leftover("control group", str(mine)).remove()
    living.remove()
    assert not mine.exists()


class OneContainer:
    """An engine with one container of our user's."""

    def __init__(self, folder: Path, status: str) -> None:
        labels = {FOLDER_LABEL: str(folder), USER_LABEL: str(os.geteuid())}
        self.said = {"Name": "/it", "Config": {"Labels": labels}, "State": {"Status": status}}

    def run(self, command: str, *_: str) -> str:
        """What ``ps`` and ``inspect`` print."""
        return "id" if command == "ps" else json.dumps([self.said])


@pytest.mark.parametrize(
    ("client", "status", "stale"),
    [
        ("dead", "running", True),
        ("dead", "exited", True),
        ("alive", "running", False),
        ("alive", "exited", False),
        ("another machine's", "running", False),
        ("another machine's", "created", False),
        ("another machine's", "paused", False),
        ("another machine's", "exited", True),
        ("no folder of ours", "running", False),
    ],
)
def test_what_runs_for_a_client_of_another_machine_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, client: str, status: str, stale: bool
) -> None:
    """An engine may be reached from many machines: whether their processes live is unknown here."""
    if client == "dead":
        folder(tmp_path, "envhub-docker-client00", {"alive": ""})
    elif client == "alive":
        alive(tmp_path, "envhub-docker-client00")
    name = "envhub-docker-client00"
    if client == "no folder of ours":  # whatever a label says
        name = folder(tmp_path, "data", {"alive": ""}).name
    engine: Any = OneContainer(tmp_path / name, status)
    assert [one.name for one in leftovers.stale_containers(engine)] == ["it"] * stale
    monkeypatch.setattr(leftovers, "user_id", lambda: os.geteuid() + 1)
    assert not list(leftovers.stale_containers(engine)), "another user's"
