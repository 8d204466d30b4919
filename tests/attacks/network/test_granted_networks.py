"""A jail that was given a network: its own loopback device, or the host's network.

Its own is nobody else's, neither the host's nor another jail's. The host's is TCP and UDP, and
nothing besides: no other protocol, no socket file and no service of ours.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from envhub_sandbox.hub import store
from envhub_sandbox.sandboxes.process import PROCESS
from tests.attacks.harness import USER, Arena, Run, call, control_run, new_alias, token
from tests.attacks.network.listeners import Listener, listening
from tests.support.interpreter import profiles

FAMILY = "Network"

_USERSOCK = {"family": socket.AF_NETLINK, "kind": socket.SOCK_RAW, "protocol": 2}
_TCP = {"family": socket.AF_INET, "kind": socket.SOCK_STREAM}
_LOCAL = {"family": socket.AF_UNIX, "kind": socket.SOCK_STREAM}
_UDP = {"family": socket.AF_INET, "kind": socket.SOCK_DGRAM}


def run_in(env: Any, payload: str, **arguments: Any) -> Run:
    """Run a payload in a jail that is open already."""
    run = Run(new_alias(), True)
    call(env, run, payload, arguments)
    return run


def sends(
    arena: Arena, env: Any, title: str, payload: str, listener: Listener, **arguments: Any
) -> None:
    """What the control tells ``listener`` does not come from a jail that is open already."""
    before, message = token(), token()
    with control_run(payload, {"message": before, **arguments}) as control:
        assert listener.heard(before, wait=True), control.text
    run = run_in(env, payload, message=message, **arguments)
    arena.judge(title, "succeeds", listener.heard(message, wait=False), run.text)


@contextlib.contextmanager
def with_loopback(arena: Arena, port: int = 0) -> Iterator[tuple[Any, int]]:
    """A jail whose own loopback device works, and the port on which it listens there."""
    with arena.environment({"network": "loopback"}) as env:
        message = token()
        run = run_in(env, "listen", port=port, message=message)
        assert message in run_in(env, "listen", port=None, message="").text, run.text
        yield env, int(run.value)


@pytest.mark.parametrize("arena", profiles("strict"), indirect=True)
def test_its_own_loopback_is_not_the_hosts(arena: Arena) -> None:
    """What listens on the host's loopback device hears nothing, over no protocol."""
    name = f"envhub-{token()}"
    at = {"address": ("127.0.0.1", 0)}
    with with_loopback(arena) as (env, _):
        for what, payload, options in (
            ("TCP", "tcp", {**_TCP, **at}),
            ("UDP", "udp", {**_UDP, **at}),
            ("MPTCP", "mptcp", {**_TCP, **at}),
            ("netlink", "netlink_message", {**_USERSOCK, "address": (0, 0)}),
            ("an abstract socket", "unix_stream", {**_LOCAL, "address": f"\0{name}"}),
        ):
            with listening(**options) as listener:
                arguments = arguments_for(listener, options["family"], name)
                title = f'with network="loopback": {what}'
                sends(arena, env, title, payload, listener, **arguments)


def arguments_for(listener: Listener, family: int, name: str) -> dict[str, Any]:
    """How a payload is told where a listener is."""
    if family == socket.AF_UNIX:
        return {"path": f"@{name}"}
    if family == socket.AF_NETLINK:
        return {"port": listener.socket.getsockname()[0]}
    return {"host": "127.0.0.1", "port": listener.port}


@pytest.mark.parametrize("arena", profiles("strict"), indirect=True)
def test_its_own_loopback_is_not_another_jails(arena: Arena) -> None:
    """A jail listens on a port, and so does the host: each hears only itself.

    The host is the first: which of its ports are free, no jail knows.
    """
    title, message = 'with network="loopback": TCP to another jail', token()
    with (
        listening(**_TCP, address=("127.0.0.1", 0)) as outside,
        with_loopback(arena, outside.port) as (other, port),
        with_loopback(arena) as (env, _),
    ):
        with control_run("tcp", {"host": "127.0.0.1", "port": port, "message": message}) as control:
            assert outside.heard(message, wait=True), control.text
        run = run_in(env, "tcp", host="127.0.0.1", port=port, message=message)
        heard = run_in(other, "listen", port=None, message="")
        assert not heard.error
        arena.judge(title, "succeeds", message in heard.text, run.text)


@pytest.mark.parametrize("arena", profiles("strict"), indirect=True)
def test_nothing_is_served_from_its_own_loopback(arena: Arena) -> None:
    """The caller finds none of a jail's ports on the host: it cannot pose as a service there."""

    def reached(port: int) -> bool:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 5):
            return True
        return False

    with control_run("listen", {"port": 0, "message": token()}) as control:
        assert reached(control.value), control.text
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and so nobody else on the host comes to listen there
        with with_loopback(arena, taken.getsockname()[1]) as (_, port):
            title = 'with network="loopback": serve on a port of the host'
            arena.judge(title, "succeeds", reached(port), "nobody listens there")


def test_the_hosts_network_is_no_more_than_tcp_and_udp(arena: Arena, home: Path) -> None:
    """Both arrive, since they were granted. Other protocols and socket files do not."""
    path = str(home / "service.sock")
    at = {"address": ("127.0.0.1", 0)}
    with arena.environment({"network": "host"}) as env:
        granted(env, "tcp", {**_TCP, **at})
        granted(env, "udp", {**_UDP, **at})
        for what, payload, options, arguments in (
            ("MPTCP", "mptcp", {**_TCP, **at}, None),
            (
                "netlink to another process",
                "netlink_message",
                {**_USERSOCK, "address": (0, 0)},
                None,
            ),
            ("a socket file", "unix_stream", {**_LOCAL, "address": path}, {"path": path}),
            *rooted(),
        ):
            with listening(**options) as listener:
                known = arguments or arguments_for(listener, options["family"], "")
                if options["family"] == socket.AF_UNIX:
                    Path(path).chmod(0o777)
                sends(arena, env, f'with network="host": {what}', payload, listener, **known)


def rooted() -> list[tuple[str, str, dict[str, Any], dict[str, Any]]]:
    """What only root can do outside."""
    if USER != "root":
        return []
    raw = {"family": socket.AF_INET, "kind": socket.SOCK_RAW, "address": ("127.0.0.1", 0)}
    frames = {"family": socket.AF_PACKET, "kind": socket.SOCK_RAW, "address": ("lo", 0x88B5)}
    return [
        ("raw ICMP", "raw_icmp", {**raw, "protocol": 1}, {"host": "127.0.0.1"}),
        ("raw frames", "packet", {**frames, "protocol": socket.htons(0x88B5)}, {"device": "lo"}),
    ]


def granted(env: Any, payload: str, options: dict[str, Any]) -> None:
    """What was asked for is there, so that the rest does not fail for want of a network."""
    with listening(**options) as listener:
        message = token()
        run = run_in(env, payload, host="127.0.0.1", port=listener.port, message=message)
        assert listener.heard(message, wait=True), run.text


def test_servers_sockets_are_not_part_of_the_hosts_network(arena: Arena) -> None:
    """The folder with a server's socket and the one that takes descriptors is out of reach."""
    use = PROCESS.acquire(store.cache_root() / "snapshots")
    server = use.server
    place = server.folder / f"{token()[:8]}.sock"
    server.folder.chmod(0o711)  # file modes shall not be what stops it
    try:
        with (
            arena.environment({"network": "host"}) as env,
            listening(**_LOCAL, address=str(place)) as listener,
        ):
            place.chmod(0o777)
            title = 'with network="host": a socket in the server\'s folder'
            sends(arena, env, title, "unix_stream", listener, path=str(place))
    finally:
        server.folder.chmod(0o700)
        use.release()


def test_addresses_are_not_listed_over_netlink_with_the_hosts_network(arena: Arena) -> None:
    """Netlink stays shut: no routes, neighbours, or rules of a firewall are asked for."""
    macs = [
        address.address.replace(":", "")
        for addresses in psutil.net_if_addrs().values()
        for address in addresses
        if address.family == psutil.AF_LINK and address.address.strip("0:")
    ]
    arena.attack(
        'with network="host": list devices over netlink',
        "netlink_routes",
        lambda run: any(mac in run.text for mac in macs),
        policy={"network": "host"},
        impossible="" if macs else "this host has no network device besides lo",
    )
