"""A jail that was given a network: its own loopback device, or the host's network.
Its own is nobody else's, neither the host's nor another jail's. The host's is TCP and UDP, and
nothing besides: no other protocol, no socket file and no service of ours."""

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from envhub_sandbox.sandboxes.process import PROCESS
from envhub_sandbox.system.folders import cache_root
from tests.attacks.harness import USER, Arena, OpenJail, control_run, run_in, token
from tests.attacks.network.listeners import (
    FRAMES,
    ICMP,
    NETLINK,
    TCP,
    UDP,
    listening,
    network_addresses,
    sends,
)

FAMILY = "Network"
_LOCAL = {"family": socket.AF_UNIX, "kind": socket.SOCK_STREAM}


@contextlib.contextmanager
def with_loopback(arena: Arena, port: int = 0) -> Iterator[tuple[Any, int]]:
    with arena.environment({"network": "loopback"}) as env:
        message = token()
        run = run_in(env, "listen", port=port, message=message)
        assert message in run_in(env, "listen", port=None, message="").text, run.text
        yield env, int(run.value)


def test_its_own_loopback_is_not_the_hosts(strict: Arena) -> None:
    """What listens on the host's loopback device hears nothing, over no protocol."""
    with with_loopback(strict) as (env, _):
        jail = OpenJail(strict, env, 'with network="loopback": ')
        for what, payload, options in (
            ("TCP", "tcp", TCP),
            ("UDP", "udp", UDP),
            ("MPTCP", "mptcp", TCP),
            ("netlink", "netlink_message", NETLINK),
            ("an abstract socket", "unix_stream", {**_LOCAL, "address": f"\0envhub-{token()}"}),
        ):
            with listening(**options) as listener:
                sends(jail, what, payload, listener)


def test_its_own_loopback_is_not_another_jails(strict: Arena) -> None:
    """A jail listens on a port, and so does the host: each hears only itself.
    The host is the first: which of its ports are free, no jail knows."""
    title, message = 'with network="loopback": TCP to another jail', token()
    with (
        listening(**TCP) as outside,
        with_loopback(strict, outside.port) as (other, port),
        with_loopback(strict) as (env, _),
    ):
        with control_run("tcp", {"host": "127.0.0.1", "port": port, "message": message}) as control:
            assert outside.heard(message, wait=True), control.text
        run = run_in(env, "tcp", host="127.0.0.1", port=port, message=message)
        heard = run_in(other, "listen", port=None, message="")
        assert not heard.error
        strict.judge(title, "succeeds", message in heard.text, run.text)


def test_nothing_is_served_from_its_own_loopback(strict: Arena) -> None:
    """The caller finds none of a jail's ports on the host: it cannot pose as a service there."""

    def reached(port: int) -> bool:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 5):
            return True
        return False

    with control_run("listen", {"port": 0, "message": token()}) as control:
        assert reached(control.value), control.text
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and so nobody else on the host comes to listen there
        with with_loopback(strict, taken.getsockname()[1]) as (_, port):
            title = 'with network="loopback": serve on a port of the host'
            strict.judge(title, "succeeds", reached(port), "nobody listens there")


def test_the_hosts_network_is_no_more_than_tcp_and_udp(arena: Arena, home: Path) -> None:
    """Both arrive, since they were granted. Other protocols and socket files do not.
    Netlink stays shut, too: no routes, neighbours, or rules of a firewall are asked for."""
    path = home / "service.sock"
    with arena.environment({"network": "host"}) as env:
        granted(env, "tcp", TCP)
        granted(env, "udp", UDP)
        jail = OpenJail(arena, env, 'with network="host": ')
        rooted = [("raw ICMP", "raw_icmp", ICMP), ("raw frames", "packet", FRAMES)]
        for what, payload, options in (
            ("MPTCP", "mptcp", TCP),
            ("netlink to another process", "netlink_message", NETLINK),
            ("a socket file", "unix_stream", {**_LOCAL, "address": str(path)}),
            *(rooted if USER == "root" else ()),
        ):
            with listening(**options) as listener:
                if path.exists():
                    path.chmod(0o777)
                sends(jail, what, payload, listener)
        macs = network_addresses()
        jail.attack(
            "list devices over netlink",
            "netlink_routes",
            lambda run: any(mac in run.text for mac in macs),
            impossible="" if macs else "this host has no network device besides lo",
        )


def granted(env: Any, payload: str, options: dict[str, Any]) -> None:
    """What was asked for is there, so that the rest does not fail for want of a network."""
    with listening(**options) as listener:
        message = token()
        run = run_in(env, payload, message=message, **listener.where)
        assert listener.heard(message, wait=True), run.text


def test_servers_sockets_are_not_part_of_the_hosts_network(arena: Arena) -> None:
    """The folder with a server's socket and the one that takes descriptors is out of reach."""
    use = PROCESS.acquire(cache_root() / "snapshots")
    server = use.server
    place = server.folder / f"{token()[:8]}.sock"
    server.folder.chmod(0o711)  # file modes shall not be what stops it
    try:
        with (
            arena.environment({"network": "host"}) as env,
            listening(**_LOCAL, address=str(place)) as listener,
        ):
            place.chmod(0o777)
            jail = OpenJail(arena, env, 'with network="host": ')
            sends(jail, "a socket in the server's folder", "unix_stream", listener)
    finally:
        server.folder.chmod(0o700)
        use.release()
