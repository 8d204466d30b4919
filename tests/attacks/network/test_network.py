"""Getting something out over a network socket."""

import contextlib
import os
import socket
import threading
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.attacks.harness import USER, OpenJail, Run, token
from tests.attacks.network.listeners import (
    FRAMES,
    ICMP,
    NETLINK,
    TCP,
    TCP6,
    UDP,
    UDP6,
    listening,
    network_addresses,
    sends,
)

FAMILY = "Network"
_TCP_FASTOPEN = (socket.IPPROTO_TCP, 23, 16)
WAYS: dict[str, tuple[str, dict[str, Any]]] = {
    "TCP": ("tcp", TCP),
    "TCP over IPv6": ("tcp", TCP6),
    # a connection that is made by sending
    "TCP fast open": ("tcp_fast_open", {**TCP, "options": [_TCP_FASTOPEN]}),
    # Landlock's rules on TCP do not cover it
    "MPTCP": ("mptcp", TCP),
    # Landlock knows nothing of datagrams
    "UDP": ("udp", UDP),
    "UDP over IPv6": ("udp", UDP6),
    # a question to a name server, the classic way out of a closed network
    "DNS query": ("dns", UDP),
    "netlink to another process": ("netlink_message", NETLINK),
}
ROOTS: dict[str, tuple[str, dict[str, Any], dict[str, Any], str]] = {
    "raw ICMP": ("raw_icmp", ICMP, {"host": "127.0.0.1"}, "only root may make raw sockets"),
    "raw frames": ("packet", FRAMES, {"device": "lo"}, "only root may make packet sockets"),
}


@pytest.mark.short("strict-TCP", "strict-DNS")
@pytest.mark.parametrize("title", WAYS)
def test_nothing_gets_out(jail: OpenJail, title: str) -> None:
    payload, options = WAYS[title]
    with listening(**options) as listener:
        sends(jail, title, payload, listener)


@pytest.mark.parametrize("title", ROOTS)
def test_raw_packets_do_not_get_out(jail: OpenJail, title: str) -> None:
    payload, options, where, why = ROOTS[title]
    if USER == "root":
        with listening(**options) as listener:
            sends(jail, title, payload, listener)
    else:
        more = {**where, "message": token(), "impossible": why}
        jail.attack(title, payload, lambda run: not run.error, **more)


def test_addresses_of_the_host_are_not_told(jail: OpenJail) -> None:
    macs = network_addresses()
    jail.attack(
        "list the host's network devices over netlink",
        "netlink_routes",
        lambda run: any(mac in run.text for mac in macs),
        impossible="" if macs else "this host has no network device besides lo",
    )


def test_events_of_the_hosts_devices_are_not_told(jail: OpenJail) -> None:
    mark = token().upper()
    with _device_events(mark) as impossible:
        jail.attack(
            "hear of the host's devices over netlink",
            "device_events",
            lambda run: mark in run.text,
            group=1,
            seconds=60,
            inside={"seconds": 1},
            impossible=impossible,
        )


@contextlib.contextmanager
def _device_events(mark: str) -> Iterator[str]:
    """The kernel tells of a change of /dev/null all the time, in which the mark stands."""
    stop, event = threading.Event(), f"change {uuid.uuid4()} MARK={mark}"
    trigger = Path("/sys/devices/virtual/mem/null/uevent")
    try:
        trigger.write_text(event)
    except OSError:
        yield "only root may trigger events of devices"
        return

    def tell() -> None:
        while not stop.wait(0.1):
            trigger.write_text(event)

    teller = threading.Thread(target=tell)
    teller.start()
    try:
        yield ""
    finally:
        stop.set()
        teller.join()


@pytest.mark.parametrize("table", ["tcp", "unix"])
def test_tables_of_the_hosts_sockets_are_not_told(jail: OpenJail, home: Path, table: str) -> None:
    """Who talks to whom, and what the socket files are called, is in /proc as well."""
    path = home / f"{token()}.sock"
    with listening(**TCP) as inet, listening(socket.AF_UNIX, socket.SOCK_STREAM, str(path)):
        mark = f" 0100007F:{inet.port:04X} " if table == "tcp" else path.name
        title = f"read the host's table of sockets: {table}"
        jail.steal(title, "network_table", mark, name=table)


def test_vsock_does_not_get_out(jail: OpenJail) -> None:
    jail.attack(
        "vsock",
        "socket_of_family",
        lambda run: has_socket(run, "AF_VSOCK"),
        family=socket.AF_VSOCK,
        kind=socket.SOCK_STREAM,
        protocol=0,
        impossible=without_family(socket.AF_VSOCK),
    )


@pytest.mark.parametrize(
    ("title", "family", "kind", "protocol", "name"),
    [
        ("AF_ALG (the kernel's ciphers)", 38, socket.SOCK_SEQPACKET, 0, "ALG"),
        ("netlink, audit", socket.AF_NETLINK, socket.SOCK_RAW, 9, "NETLINK"),
        ("netlink, connector", socket.AF_NETLINK, socket.SOCK_RAW, 11, "NETLINK"),
        ("netlink, netfilter", socket.AF_NETLINK, socket.SOCK_RAW, 12, "NETLINK"),
        ("netlink, generic", socket.AF_NETLINK, socket.SOCK_RAW, 16, "NETLINK"),
        ("UDP-Lite", socket.AF_INET, socket.SOCK_DGRAM, 136, "UDP-Lite"),
        ("XDP", 44, socket.SOCK_RAW, 0, "XDP"),
        ("packet socket", socket.AF_PACKET, socket.SOCK_RAW, 0, "PACKET"),
    ],
)
def test_socket_families_are_closed(
    jail: OpenJail, title: str, family: int, kind: int, protocol: int, name: str
) -> None:
    jail.attack(
        f"socket: {title}",
        "socket_of_family",
        lambda run: has_socket(run, name),
        family=family,
        kind=kind,
        protocol=protocol,
        impossible=without_family(family, kind, protocol),
    )


def without_family(family: int, kind: int = socket.SOCK_STREAM, protocol: int = 0) -> str:
    try:
        socket.socket(family, kind, protocol).close()
    except OSError as error:
        return f"the kernel answers: {error.strerror}"
    return ""


def has_socket(run: Run, name: str) -> bool:
    found = []
    for pid in run.pids():
        with contextlib.suppress(OSError):  # it may end just now
            for fd in os.listdir(f"/proc/{pid}/fd"):
                with contextlib.suppress(OSError):
                    found.append(os.getxattr(f"/proc/{pid}/fd/{fd}", "system.sockprotoname"))
    return any(name.encode() == protocol.rstrip(b"\0") for protocol in found)
