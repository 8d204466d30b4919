"""What a server's clients may do: everything, or what a stranger's quotas permit.

One ``Server`` serves both. A ``LocalGate`` stands before a socket in a private folder, whose
clients are the user who started the server. A ``RemoteGate`` (``remote_gate.py``) stands before a
TCP port: its clients have proved a key, and still may neither name a path of this machine nor take
it all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import zmq

from envhub_worker.loop import Loop, receive
from envhub_worker.protocol import messages as m
from envhub_worker.server.sessions import Sessions
from envhub_worker.supervisor.jails import Jails
from envhub_worker.supervisor.records import Asker, Witness


class Incoming(NamedTuple):
    """A message as it came.

    Attributes:
        key: The key that its sender has proved; empty where none is needed.
        fd: The descriptor of the connection that it came over; -1 if that is not known.
    """

    identity: bytes
    key: bytes
    frames: list[Any]
    fd: int = -1


Payload = Sequence[bytes]
Handler = Callable[[Asker, Any, Payload], m.Message]
"""Carries out a permitted request and returns the reply."""


class Gate:
    """Decides what a client may do. A subclass must say what is permitted.

    Attributes:
        handlers: The requests that only this gate knows.
        compresses: Whether frames are worth compressing.
        idle_s: How long the jails of a client that says nothing live on; 0 for ever.
        sessions, jails: The server's, since ``begin``.
    """

    sessions: Sessions
    jails: Jails
    handlers: Mapping[type[m.Message], Handler] = {}
    compresses = False
    idle_s = 0
    witness = Witness()

    def begin(self, sessions: Sessions, jails: Jails) -> None:
        """The server exists now."""
        self.sessions, self.jails = sessions, jails

    def receive(self, router: zmq.Socket[bytes]) -> Incoming:
        """Receive the next message."""
        raise NotImplementedError

    def greet(self, arrived: Incoming, name: bytes) -> None:
        """A session of this name begins, or is found again; raises ``RefusedError``."""
        raise NotImplementedError

    def authorize(self, asker: Asker, request: m.Message, payload: Payload) -> m.Message:
        """The request as it may be carried out, never a reply; raises ``RefusedError``."""
        raise NotImplementedError

    def secure(self, router: zmq.Socket[bytes], loop: Loop) -> None:
        """Set what must be set before the socket is bound."""

    def answered(self, asker: Asker, reply: m.Message) -> None:
        """A request has this answer."""

    def tick(self) -> None:
        """A second has passed."""

    def drain(self) -> bool:
        """Let nothing new in from now on; False if nothing that runs is waited for."""
        return False

    def drained(self) -> bool:
        """Whether ``drain`` was called, and nothing runs any more."""
        return False

    def close(self) -> None:
        """End all sessions; close what ``secure`` opened."""


class LocalGate(Gate):
    """The folder of the socket, of mode 0700, is the gate: who can reach it is the user."""

    def receive(self, router: zmq.Socket[bytes]) -> Incoming:
        """No client has a key."""
        identity, *frames = receive(router)
        return Incoming(identity, b"", frames)

    def greet(self, arrived: Incoming, name: bytes) -> None:
        """Every client is welcome."""
        self.sessions.connect(arrived.identity, arrived.key, name)

    def authorize(self, asker: Asker, request: m.Message, payload: Payload) -> m.Message:
        """Everything is permitted."""
        return request
