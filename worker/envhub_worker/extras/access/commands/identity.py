"""The identity of a ``listen``: its address, its keys, its clients' keys, its announcement."""

from __future__ import annotations

import argparse
import contextlib
import ipaddress
from dataclasses import dataclass
from pathlib import Path

from envhub_worker import __version__
from envhub_worker.extras.access import keys
from envhub_worker.extras.access.keys import KeyPair
from envhub_worker.protocol.confinement import PROFILES
from envhub_worker.protocol.keys import key_text

_ANY_HOST = frozenset({"0.0.0.0", "*", "[::]"})


class UsageError(Exception):
    """The arguments ask for something that is forbidden or impossible."""


@dataclass(frozen=True)
class Identity:
    """The server's keys and its clients.

    Attributes:
        keys: The server's key pair; None only with ``--insecure-loopback``.
        client: The only client, named by an option or made because there is no list of clients.
        fresh: Whether that client's key was made just now.
        profile: The strongest profile that jails can have here.
    """

    keys: KeyPair | None
    authorized: Path | None = None
    client: KeyPair | None = None
    client_file: Path | None = None
    fresh: bool = False
    profile: str = "strict"

    @property
    def public(self) -> str:
        """The server's public key as text, or ``insecure``."""
        return "insecure" if self.keys is None else key_text(self.keys.public)


def identity_of(arguments: argparse.Namespace, state: Path) -> Identity:
    """Returns the identity by the arguments; without keys in them, by the state folder's."""
    if arguments.insecure_loopback:
        if arguments.key or arguments.authorized_clients or arguments.only_client:
            raise UsageError(
                "--insecure-loopback has no keys: leave out --key and the other options for keys"
            )
        return Identity(None)
    if arguments.only_client and arguments.authorized_clients:
        raise UsageError("--only-client is instead of --authorized-clients: leave one out")
    if arguments.only_client:
        pair = keys.load(arguments.key) if arguments.key else keys.generate()  # for this life only
        return Identity(pair, client=KeyPair(arguments.only_client, b""))
    pair = keys.load(arguments.key) if arguments.key else _kept_pair(state, "server")[0]
    if arguments.authorized_clients:
        if not arguments.authorized_clients.exists():
            raise UsageError(
                f"--authorized-clients: there is no file {arguments.authorized_clients}. It has a "
                "client on each line: its public key ('envhub-worker keygen' makes one), and a name"
            )
        return Identity(pair, arguments.authorized_clients)
    client, fresh = _kept_pair(state, "client")
    return Identity(pair, None, client, state / "client.key", fresh)


def _kept_pair(state: Path, name: str) -> tuple[KeyPair, bool]:
    """Returns the key pair of the state folder, and whether it was made just now."""
    with contextlib.suppress(FileNotFoundError):
        return keys.load(state / f"{name}.key"), False
    pair = keys.generate()
    (state / f"{name}.pub").unlink(missing_ok=True)
    keys.save(pair, state, name)
    return pair, True


def announcement(endpoint: str, identity: Identity) -> str:
    """Returns the text to print at the start: endpoint, public key, and a client's ``make_env``."""
    lines = [f"envhub-worker {__version__} listens on {endpoint}"]
    reached = reachable(endpoint)
    policy = "" if identity.profile == "strict" else f", policy={{'profile': {identity.profile!r}}}"
    if policy:
        lines.append(f"jails here can have the profile {identity.profile!r} at most")
    if reached != endpoint:
        lines.append(f"(on all interfaces; from another host write its name for {reached!r})")
    if identity.keys is None:
        lines += ["No keys: every user of this machine can run code here.", ""]
        client = f"RemoteSandbox({reached!r}, insecure_loopback=True){policy}"
        return "\n".join([*lines, f"sandbox=envhub_sandbox.{client}"])
    lines.append(f"server's public key: {identity.public}")
    lines.append("")
    if identity.client is None:
        lines.append(f"Clients: those in {identity.authorized}. A client writes:")
        secret = "<its secret key, or the file that holds it>"
    elif not identity.client.secret:
        lines.append("Clients: the one of --only-client. It writes:")
        secret = "<its secret key, or the file that holds it>"
    elif identity.fresh:
        lines.append(f"No --authorized-clients: one client key was made ({identity.client_file}).")
        lines.append("A client with this key can run code here, confined. The client writes:")
        secret = key_text(identity.client.secret)
    else:
        lines.append("No --authorized-clients: one client key, made earlier. The client writes:")
        secret = f"<what {identity.client_file} holds>"
    lines.append(
        f'  sandbox=envhub_sandbox.RemoteSandbox("{reached}", server_key="{identity.public}", '
        f'client_key="{secret}"){policy}'
    )
    lines.append(f'or, in its environment, and then sandbox="{reached}"{policy}:')
    lines.append(f"  ENVHUB_SERVER_KEY={identity.public} ENVHUB_CLIENT_KEY={secret!r}")
    return "\n".join(lines)


def unusable(strongest: str, weakest: str) -> str:
    """Returns a warning if this host cannot run a jail of any permitted profile; else empty."""
    if PROFILES.index(strongest) <= PROFILES.index(weakest):
        return ""
    return (
        f"no jail can be opened here: the strongest profile to be had is {strongest!r}, and "
        f"--weakest-profile permits nothing weaker than {weakest!r}"
    )


def reachable(endpoint: str) -> str:
    """Returns an endpoint that a client on this machine can connect to."""
    host, _, port = endpoint.removeprefix("tcp://").rpartition(":")
    return f"tcp://127.0.0.1:{port}" if host in _ANY_HOST else endpoint


def check_bind(endpoint: str, insecure: bool) -> None:
    """Raises ``UsageError`` unless the address is TCP, and loopback if it must be."""
    host, _, port = endpoint.removeprefix("tcp://").rpartition(":")
    a_port = port == "*" or (port.isdigit() and int(port) <= 65_535)
    if not endpoint.startswith("tcp://") or not host or not a_port:
        raise UsageError(f"--bind takes tcp://HOST:PORT, not {endpoint!r}")
    if insecure and not is_loopback(host):
        raise UsageError(
            f"--insecure-loopback needs a loopback address such as 127.0.0.1, and {host!r} is "
            "none: without keys anybody who reaches it could run code here"
        )


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
