"""What a server's clients may do: everything, or what a stranger's quotas permit.

One ``Server`` serves both. A ``LocalGate`` stands before a socket in a private folder, whose
clients are the user who started the server. A ``RemoteGate`` (``remote_gate.py``) stands before a
TCP port: its clients have proved a key, and still may neither name a path of this machine nor take
it all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import zmq

from envhub_worker.access.sessions import Sessions
from envhub_worker.loop import Loop
from envhub_worker.multipart import receive
from envhub_worker.protocol import messages as m
from envhub_worker.supervisor.jails import Jails
from envhub_worker.supervisor.records import Asker
from envhub_worker.supervisor.witness import Nobody, Witness


class Asked(NamedTuple):
    """A request, who asks, and what it is asked of."""

    asker: Asker
    request: m.Message
    payload: Sequence[bytes]
    sessions: Sessions
    jails: Jails


class Arrived(NamedTuple):
    """A message as it came.

    Attributes:
        key: The key that he has proved; empty where none is needed.
        fd: The descriptor of the connection that it came over; -1 if that is not known.
    """

    identity: bytes
    key: bytes
    frames: list[Any]
    fd: int = -1


class Greeting(NamedTuple):
    """A ``Hello``: whose it is, and the name of the session that it asks for."""

    arrived: Arrived
    name: bytes
    sessions: Sessions
    jails: Jails


Handler = Callable[[Asked], m.Message]
"""Carries a request out that is permitted; returns the reply."""


class Gate(Protocol):
    """Decides what a client may.

    Attributes:
        handlers: The requests that only this gate knows.
        compresses: Whether frames are worth compressing.
        idle_s: How long the jails of a client that says nothing live on; 0 for ever.
    """

    handlers: Mapping[type[m.Message], Handler]
    compresses: bool
    idle_s: int
    witness: Witness

    def secure(self, router: zmq.Socket[bytes], loop: Loop) -> None:
        """Set what must be set before the socket is bound."""

    def receive(self, router: zmq.Socket[bytes]) -> Arrived:
        """A message that is there."""

    def greet(self, greeting: Greeting) -> None:
        """A session begins, or is found again; raises ``RefusedError``."""

    def authorize(self, asked: Asked) -> m.Message:
        """The request as it may be carried out, never a reply; raises ``RefusedError``."""

    def answered(self, asker: Asker) -> None:
        """A request was answered."""

    def refused(self, asker: Asker, refused: m.Refused) -> None:
        """A request was answered so."""

    def tick(self, sessions: Sessions, jails: Jails) -> None:
        """Time has passed."""

    def drain(self) -> bool:
        """Let nothing new in from now on; False if nothing that runs is waited for."""

    def drained(self, jails: Jails) -> bool:
        """Whether that has been said, and nothing runs any more."""

    def close(self, sessions: Sessions) -> None:
        """Everybody has to go; close what ``secure`` opened."""


class LocalGate:
    """The folder of the socket is the gate: whoever can reach it is the user."""

    handlers: Mapping[type[m.Message], Handler] = MappingProxyType({})
    compresses = False
    idle_s = 0
    witness: Witness = Nobody()

    def secure(self, router: zmq.Socket[bytes], loop: Loop) -> None:
        """Nothing: the folder is of mode 0700."""

    def receive(self, router: zmq.Socket[bytes]) -> Arrived:
        """Nobody has a key."""
        identity, *frames = receive(router)
        return Arrived(identity, b"", frames)

    def greet(self, greeting: Greeting) -> None:
        """Everybody is welcome."""
        arrived = greeting.arrived
        greeting.sessions.connect(arrived.identity, arrived.key, greeting.name)

    def authorize(self, asked: Asked) -> m.Message:
        """Everything is permitted."""
        return asked.request

    def answered(self, asker: Asker) -> None:
        """Nothing is counted."""

    def refused(self, asker: Asker, refused: m.Refused) -> None:
        """Its client says so."""

    def tick(self, sessions: Sessions, jails: Jails) -> None:
        """The server ends with its client."""

    def drain(self) -> bool:
        """There is one client, and it would wait for itself."""
        return False

    def drained(self, jails: Jails) -> bool:
        """Never."""
        return False

    def close(self, sessions: Sessions) -> None:
        """There is nothing to close."""
