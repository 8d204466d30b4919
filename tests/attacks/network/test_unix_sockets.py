"""Reaching services of this machine through AF_UNIX: docker, an ssh agent, the system's log."""

import socket
from pathlib import Path

import pytest

from tests.attacks.harness import USER, Arena, OpenJail, token
from tests.attacks.network.listeners import listening, sends

FAMILY = "AF_UNIX sockets"


@pytest.mark.short("strict-a docker socket")
@pytest.mark.parametrize(
    ("title", "place"),
    [
        ("a docker socket", "{run}/docker.sock"),
        ("an ssh agent", "{tmp}/agent.1234"),
        ("a service in the home", "{home}/service.sock"),
    ],
)
def test_socket_files_accept_nobody(jail: OpenJail, home: Path, title: str, place: str) -> None:
    path = Path(place.format(run=run_folder(), tmp=f"/tmp/ssh-{token()[:8]}", home=home))
    path.parent.mkdir(exist_ok=True)
    try:
        with listening(socket.AF_UNIX, socket.SOCK_STREAM, str(path)) as listener:
            path.parent.chmod(0o755)
            path.chmod(0o777)
            sends(jail, f"connect to {title}", "unix_stream", listener)
    finally:
        path.unlink()
        if path.parent != home:
            path.parent.rmdir()


def run_folder() -> Path:
    """A folder in /run for root, where docker's is; elsewhere for those who may not write there.
    Its path is short: that of a socket has 108 bytes."""
    return Path("/run" if USER == "root" else "/var/tmp") / f"envhub-{token()[:8]}"


def send_to_an_abstract_socket(jail: OpenJail, title: str, payload: str) -> None:
    kind = socket.SOCK_STREAM if payload == "unix_stream" else socket.SOCK_DGRAM
    with listening(socket.AF_UNIX, kind, f"\0envhub-{token()}") as listener:
        sends(jail, title, payload, listener)


def test_abstract_sockets_cannot_be_reached(jail: OpenJail) -> None:
    send_to_an_abstract_socket(jail, "connect to an abstract socket", "unix_stream")
    send_to_an_abstract_socket(jail, "datagram to an abstract socket", "unix_datagram")


def test_abstract_sockets_are_not_part_of_the_hosts_network(arena: Arena) -> None:
    """Who grants the network grants TCP and UDP, and no service that has only a name."""
    with arena.environment({"network": "host"}) as env:
        jail = OpenJail(arena, env, "reach an abstract socket on the host's network: ")
        for payload in ("unix_stream", "unix_datagram"):
            send_to_an_abstract_socket(jail, payload, payload)


@pytest.mark.parametrize(
    ("title", "payload"),
    [
        ("datagram to a socket like /dev/log", "unix_datagram"),
        ("datagram to a socket file, from a socket pair", "unix_datagram_of_a_pair"),
    ],
)
def test_datagrams_do_not_arrive(jail: OpenJail, home: Path, title: str, payload: str) -> None:
    path = home / "log"
    with listening(socket.AF_UNIX, socket.SOCK_DGRAM, str(path)) as listener:
        path.chmod(0o777)
        sends(jail, title, payload, listener)
