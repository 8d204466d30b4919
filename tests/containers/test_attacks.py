"""The attacks that a container is for, each with a control that succeeds without one.
In a jail with namespaces, in a jail without, and in no jail at all, next to the server: the last
one shows what the container's own walls hold."""

import json
import os
import socket
from pathlib import Path

import psutil
import pytest

from envhub_sandbox.extras.docker.engines import Engine
from envhub_sandbox.extras.docker.sandbox import DockerSandbox
from envhub_sandbox.hub.snapshot import local
from tests.attacks.harness import HOSTILE, token
from tests.attacks.network.listeners import listening, sends
from tests.attacks.processes.victim import victim
from tests.attacks.resources.accounts import of_processes, tasks
from tests.containers.kit import Walls, container_of, pids_in
from tests.support.processes import unless_ended
from tests.support.started import started

MIB = 1 << 20
MEMORY, BOMB = 512 * MIB, 896 * MIB
PIDS, FORKS = 96, 240
_SOCKET = Path("/var/run/docker.sock")


def an_address_of_this_machine() -> str:
    """One that a network of any kind would lead to; the loopback has another meaning inside."""
    found = [
        one.address
        for name, addresses in psutil.net_if_addrs().items()
        for one in addresses
        if one.family == socket.AF_INET and name != "lo"
    ]
    return found[0] if found else pytest.skip("this machine has no network but its loopback")


@pytest.mark.parametrize(
    ("payload", "kind"), [("tcp", socket.SOCK_STREAM), ("udp", socket.SOCK_DGRAM)]
)
def test_nothing_reaches_the_network(walls: Walls, payload: str, kind: int) -> None:
    """A listener on this machine hears the control only."""
    address = an_address_of_this_machine()
    with listening(socket.AF_INET, kind, (address, 0)) as listener:
        sends(walls, payload.upper(), payload, listener, host=address, port=listener.port)


def test_abstract_sockets_of_this_machine_are_out_of_reach(walls: Walls) -> None:
    name = f"@{token()}"
    with listening(socket.AF_UNIX, socket.SOCK_STREAM, "\0" + name[1:]) as listener:
        sends(walls, "abstract socket", "unix_stream", listener, path=name)


def test_socket_files_of_this_machine_are_out_of_reach(walls: Walls, open_ground: Path) -> None:
    path = str(open_ground / "socket")
    with listening(socket.AF_UNIX, socket.SOCK_STREAM, path) as listener:
        os.chmod(path, 0o777)
        sends(walls, "socket file", "unix_stream", listener, path=path)


@pytest.mark.skipif(not os.access(_SOCKET, os.W_OK), reason=f"{_SOCKET} is not ours to use")
def test_the_engine_is_out_of_reach(walls: Walls, engine: Engine) -> None:
    if engine.kind != "docker":
        pytest.skip(f"{engine.kind} has no server whose socket could be reached")
    secret = json.loads(engine.run("info", "--format", "{{json .ID}}"))
    walls.attack("docker.sock", "docker_api", lambda run: secret in run.text, path=str(_SOCKET))


def test_files_of_this_machine_cannot_be_read(walls: Walls, open_ground: Path) -> None:
    secret = token()
    (open_ground / "canary").write_text(secret)
    path = str(open_ground / "canary")
    walls.attack("read a file", "read_file", lambda run: secret in run.text, path=path)


def test_files_of_this_machine_cannot_be_written(walls: Walls, open_ground: Path) -> None:
    path = open_ground / "planted"
    walls.attack(
        "write a file",
        "create_file",
        lambda run: path.exists(),
        before=lambda: path.unlink(missing_ok=True),
        path=str(path),
        text="x",
    )


def test_the_snapshot_cannot_be_written(walls: Walls, open_ground: Path) -> None:
    """The repository's files are shown, and are this machine's: read-only for everybody."""
    outside, inside = open_ground / "planted", local(HOSTILE).root / "planted"
    walls.attack(
        "write into the snapshot",
        "create_file",
        lambda run: (inside if run.inside else outside).exists(),
        inside={"path": "/snapshots/this/planted"},
        path=str(outside),
        text="x",
    )


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can make a device, so: no control")
def test_devices_of_this_machine_cannot_be_opened(walls: Walls) -> None:
    """Making a node takes a capability, and opening it a rule: there is neither."""
    secret = token()
    with open("/dev/kmsg", "w") as log:
        log.write(f"envhub test {secret}\n")
    walls.attack("open a device", "kernel_log_device", lambda run: secret in run.text)


def test_environments_of_other_processes_cannot_be_read(walls: Walls) -> None:
    """A process of this machine is not there to be looked at."""
    secret = token()
    with victim(secret) as other:
        walls.attack(
            "read an environment",
            "environment_of_others",
            lambda run: secret in run.text,
            pid=other.pid,
        )


def test_memory_stops_at_the_containers_limit(walls: Walls) -> None:
    walls.options = {"memory": MEMORY}
    walls.attack(
        "memory bomb",
        "memory_bomb",
        lambda run: of_processes(run, "Pss") > MEMORY + 64 * MIB,
        limits={"memory_bytes": 8 << 30},
        kind="heap",
        size=BOMB,
    )


def test_processes_stop_at_the_containers_limit(walls: Walls) -> None:
    walls.options = {"pids": PIDS}
    walls.attack(
        "fork bomb",
        "fork_bomb",
        lambda run: tasks(run) > PIDS,
        limits={"processes": 4096},
        count=FORKS,
    )


def test_no_process_in_a_container_has_a_capability(docker: DockerSandbox, engine: Engine) -> None:
    """Read from outside, of the server, the zygote and the runners alike; none is root."""
    with started(str(HOSTILE), sandbox=docker, seed=0) as env:
        read = 0
        for pid in pids_in(engine, container_of(env)):
            text = ""
            with unless_ended(pid):
                text = Path(f"/proc/{pid}/status").read_text()
            if not text:
                continue
            read += 1
            status = dict(line.split(":\t", 1) for line in text.splitlines() if ":\t" in line)
            assert int(status["CapBnd"], 16) == 0 or _in_a_namespace_of_its_own(pid)
            assert (status["NoNewPrivs"].strip(), status["Seccomp"].strip()) == ("1", "2")
            assert "0" not in status["Uid"].split()
        assert read >= 4


def _in_a_namespace_of_its_own(pid: int) -> bool:
    """A capability over a user namespace of one's own is none over anything outside."""
    return os.readlink(f"/proc/{pid}/ns/user") != os.readlink("/proc/self/ns/user")
