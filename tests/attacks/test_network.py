"""Getting something out over a network socket."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import psutil
import pytest

from tests.attacks.harness import USER, Arena, Run, token
from tests.attacks.listeners import listening, sends

FAMILY = "Network"

_NETLINK_USERSOCK = 2
_TCP_FASTOPEN = (socket.IPPROTO_TCP, 23, 16)
_ETHERTYPE = 0x88B5


@pytest.mark.short("strict")
@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_tcp_does_not_get_out(arena: Arena, host: str) -> None:
    """A listener on the host never sees the connection."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with listening(family, socket.SOCK_STREAM, (host, 0)) as listener:
        title = "TCP" if family == socket.AF_INET else "TCP over IPv6"
        sends(arena, title, "tcp", listener, host=host, port=listener.port)


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_udp_does_not_get_out(arena: Arena, host: str) -> None:
    """Nor a datagram, which Landlock knows nothing of."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with listening(family, socket.SOCK_DGRAM, (host, 0)) as listener:
        title = "UDP" if family == socket.AF_INET else "UDP over IPv6"
        sends(arena, title, "udp", listener, host=host, port=listener.port)


@pytest.mark.short("strict")
def test_dns_does_not_get_out(arena: Arena) -> None:
    """Nor a question to a name server, the classic way out of a closed network."""
    with listening(socket.AF_INET, socket.SOCK_DGRAM, ("127.0.0.1", 0)) as listener:
        sends(arena, "DNS query", "dns", listener, host="127.0.0.1", port=listener.port)


def test_tcp_fast_open_does_not_get_out(arena: Arena) -> None:
    """Nor a connection that is made by sending."""
    address = ("127.0.0.1", 0)
    with listening(socket.AF_INET, socket.SOCK_STREAM, address, _TCP_FASTOPEN) as listener:
        sends(
            arena,
            "TCP fast open",
            "tcp_fast_open",
            listener,
            host="127.0.0.1",
            port=listener.port,
        )


def test_mptcp_does_not_get_out(arena: Arena) -> None:
    """Nor multipath TCP, which Landlock's rules on TCP do not cover."""
    with listening(socket.AF_INET, socket.SOCK_STREAM, ("127.0.0.1", 0)) as listener:
        sends(arena, "MPTCP", "mptcp", listener, host="127.0.0.1", port=listener.port)


def test_netlink_does_not_get_out(arena: Arena) -> None:
    """Nor a message over netlink to another process."""
    kind = (socket.AF_NETLINK, socket.SOCK_RAW)
    with listening(*kind, (0, 0), protocol=_NETLINK_USERSOCK) as listener:
        port = listener.socket.getsockname()[0]
        sends(arena, "netlink to another process", "netlink_message", listener, port=port)


def test_addresses_of_the_host_are_not_told(arena: Arena) -> None:
    """The kernel does not list the host's network devices to a jail."""
    macs = [
        address.address.replace(":", "")
        for addresses in psutil.net_if_addrs().values()
        for address in addresses
        if address.family == psutil.AF_LINK and address.address.strip("0:")
    ]
    arena.attack(
        "list the host's network devices over netlink",
        "netlink_routes",
        lambda run: any(mac in run.text for mac in macs),
        impossible="" if macs else "this host has no network device besides lo",
    )


@pytest.mark.parametrize("table", ["tcp", "unix"])
def test_tables_of_the_hosts_sockets_are_not_told(arena: Arena, home: Path, table: str) -> None:
    """Who talks to whom, and what the socket files are called, is in /proc as well."""
    path = home / f"{token()}.sock"
    with (
        listening(socket.AF_INET, socket.SOCK_STREAM, ("127.0.0.1", 0)) as inet,
        listening(socket.AF_UNIX, socket.SOCK_STREAM, str(path)),
    ):
        mark = f" 0100007F:{inet.port:04X} " if table == "tcp" else path.name
        arena.attack(
            f"read the host's table of sockets: {table}",
            "network_table",
            lambda run: mark in run.text,
            name=table,
        )


def test_vsock_does_not_get_out(arena: Arena) -> None:
    """Nor a socket to the hypervisor, which no network namespace holds."""
    arena.attack(
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
        ("netlink, events of devices", socket.AF_NETLINK, socket.SOCK_RAW, 15, "NETLINK"),
        ("netlink, generic", socket.AF_NETLINK, socket.SOCK_RAW, 16, "NETLINK"),
        ("UDP-Lite", socket.AF_INET, socket.SOCK_DGRAM, 136, "UDP-Lite"),
        ("XDP", 44, socket.SOCK_RAW, 0, "XDP"),
        ("packet socket", socket.AF_PACKET, socket.SOCK_RAW, 0, "PACKET"),
    ],
)
def test_socket_families_are_closed(
    arena: Arena, title: str, family: int, kind: int, protocol: int, name: str
) -> None:
    """Rare socket families are ways into the kernel; a jail can make none of them."""
    arena.attack(
        f"socket: {title}",
        "socket_of_family",
        lambda run: has_socket(run, name),
        family=family,
        kind=kind,
        protocol=protocol,
        impossible=without_family(family, kind, protocol),
    )


def without_family(family: int, kind: int = socket.SOCK_STREAM, protocol: int = 0) -> str:
    """Why this kernel gives this user no such socket, or nothing if it does."""
    try:
        socket.socket(family, kind, protocol).close()
    except OSError as error:
        return f"the kernel answers: {error.strerror}"
    return ""


def has_socket(run: Run, name: str) -> bool:
    """Whether a process of the run holds a socket of a protocol, as /proc shows it from here."""
    found = []
    for pid in run.pids():
        for fd in os.listdir(f"/proc/{pid}/fd"):
            try:
                found.append(os.getxattr(f"/proc/{pid}/fd/{fd}", "system.sockprotoname"))
            except OSError:
                continue
    return any(name.encode() == protocol.rstrip(b"\0") for protocol in found)


def test_raw_packets_do_not_get_out(arena: Arena) -> None:
    """Nor a ping with a body."""
    if USER != "root":
        arena.attack(
            "raw ICMP",
            "raw_icmp",
            lambda run: not run.error,
            host="127.0.0.1",
            message=token(),
            impossible="only root may make raw sockets",
        )
        return
    kind = (socket.AF_INET, socket.SOCK_RAW)
    with listening(*kind, ("127.0.0.1", 0), protocol=socket.IPPROTO_ICMP) as listener:
        sends(arena, "raw ICMP", "raw_icmp", listener, host="127.0.0.1")


def test_frames_do_not_get_out(arena: Arena) -> None:
    """Nor a frame of its own making."""
    if USER != "root":
        arena.attack(
            "raw frames",
            "packet",
            lambda run: not run.error,
            device="lo",
            message=token(),
            impossible="only root may make packet sockets",
        )
        return
    kind = (socket.AF_PACKET, socket.SOCK_RAW)
    with listening(*kind, ("lo", _ETHERTYPE), protocol=socket.htons(_ETHERTYPE)) as listener:
        sends(arena, "raw frames", "packet", listener, device="lo")
