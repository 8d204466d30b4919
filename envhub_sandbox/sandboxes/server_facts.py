"""What a server on another host says about itself, asked without taking a place of its client's."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from time import monotonic
from typing import Any

from envhub_sandbox.sandboxes.remote import RemoteSandbox
from envhub_sandbox.transport.connection import WorkerConnection
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.replies import expect_reply
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.confinement import PROFILES
from envhub_worker.protocol.text import printable

_WAIT_S = 15.0
_LOOKER = b"status"
"""The session of a client that only looks; it is not counted."""
_WORDS = ("python", "profile", "weakest_profile")
_MOST = 1 << 63
_MOST_NAMES = 32
_MOST_CHARS = 64


@dataclass(frozen=True, kw_only=True)
class ServerFacts:
    """What is known of a server. Trust: its own words, checked for their types alone.

    Attributes:
        protocol: The version that was agreed on.
        answered_s: From knocking to its welcome.
        detailed: Whether it says more than that; older servers do not.
        profile: The strongest that a jail can have there.
        weakest_profile: That a policy may ask for.
        network: Whether a policy may ask for the server's network.
        gpu: Likewise.
        dependencies: Whether it installs what repositories declare.
        draining: Whether it is about to end, and lets nothing new in.
        quotas: What our key may have.
        used: What it has of that, all its processes together.
    """

    version: str
    protocol: int
    answered_s: float
    quotas: dict[str, int]
    used: dict[str, int]
    detailed: bool = False
    python: str = ""
    profile: str = ""
    weakest_profile: str = ""
    network: bool = False
    gpu: bool = False
    dependencies: bool = False
    draining: bool = False

    def enforces(self, profile: str) -> bool:
        """Whether a jail can have a profile there, and may."""
        known = (self.profile, profile, self.weakest_profile)
        if not all(one in PROFILES for one in known):
            return False
        strongest, asked, weakest = map(PROFILES.index, known)
        return strongest <= asked <= weakest


def ask(sandbox: RemoteSandbox) -> ServerFacts:
    """Ask a server.
    Raises ``SandboxUnavailableError``: nothing answers there, or it does not let us in;
    ``VersionMismatchError``: it shares no version of the protocol with us; ``WorkerError``: it
    refuses to answer.
    """
    begun, deadline = monotonic(), Deadline(_WAIT_S)
    with _connection(sandbox) as client:
        greeting = m.Hello(m.VERSION, _LOOKER)
        welcome = expect_reply(client.request(greeting, deadline=deadline)[0], m.Welcome)
        answered_s = monotonic() - begun
        sessions = expect_reply(client.request(m.GetSessions(), deadline=deadline)[0], m.Sessions)
    return facts_of(welcome, answered_s, sessions.server)


@contextlib.contextmanager
def _connection(sandbox: RemoteSandbox) -> Iterator[WorkerConnection]:
    never, ends = socket.socketpair()
    with never, ends:
        client = WorkerConnection(sandbox.endpoint, never.fileno(), far=sandbox.far())
        with contextlib.closing(client):
            yield client


def facts_of(welcome: m.Welcome, answered_s: float, said: dict[Any, Any]) -> ServerFacts:
    """What is kept of a server's answer. Trust: input from the server."""
    clients = said.get("clients")
    mine: object = next(iter(clients.values()), {}) if isinstance(clients, dict) else {}
    words = {name: _text(said.get(name)) for name in _WORDS}
    return ServerFacts(
        version=_text(welcome.worker),
        protocol=welcome.version,
        answered_s=answered_s,
        detailed=bool(said),
        **words,
        network=said.get("network") is True,
        gpu=said.get("gpu") is True,
        dependencies=said.get("dependencies") is True,
        draining=said.get("draining_s") is not None,
        quotas=_numbers(said.get("quotas")),
        used=_numbers(mine),
    )


def _text(value: object) -> str:
    return printable(value[:_MOST_CHARS]) if isinstance(value, str) else ""


def _numbers(value: object) -> dict[str, int]:
    """The whole numbers of a mapping, by name. Trust: input from the server."""
    if not isinstance(value, dict):
        return {}
    items = list(value.items())[:_MOST_NAMES]
    return {
        _text(name): number for name, number in items if type(number) is int and 0 <= number < _MOST
    }
