"""Decides what a server's clients may do: everything, or only what their quotas permit.

One ``Server`` class serves both. A ``LocalGate`` guards a socket in a private folder, whose clients
are the user who started the server. A ``RemoteGate`` (``remote_gate.py``) guards a TCP port: its
clients have proved a key, but may not name paths of this machine or use up its resources.
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
    """A received message.

    Attributes:
        key: The key that its sender has proved; empty if the server needs no keys.
        header: The ZeroMQ frame that knows its connection, or None.
    """

    identity: bytes
    key: bytes
    frames: list[Any]
    header: zmq.Frame | None = None


Payload = Sequence[bytes]
Handler = Callable[[Asker, Any, Payload], m.Message]
"""Carries out a permitted request and returns the reply."""


class Gate:
    """Decides what a client may do. Subclasses define what is permitted.

    Attributes:
        handlers: Handlers of requests that only this gate knows.
        compresses: Whether frames are worth compressing.
        idle_s: How long the jails of a silent client live; 0 for ever.
        sessions, jails: Those of the server, set by ``begin``.
    """

    sessions: Sessions
    jails: Jails
    handlers: Mapping[type[m.Message], Handler] = {}
    compresses = False
    idle_s = 0
    witness = Witness()

    def begin(self, sessions: Sessions, jails: Jails) -> None:
        """Take the server's sessions and jails, once the server exists."""
        self.sessions, self.jails = sessions, jails

    def receive(self, router: zmq.Socket[bytes]) -> Incoming:
        """Receive the next message."""
        raise NotImplementedError

    def greet(self, arrived: Incoming, name: bytes) -> None:
        """Permit a session to begin or to reconnect, or raise ``RefusedError``."""
        raise NotImplementedError

    def authorize(self, asker: Asker, request: m.Message, payload: Payload) -> m.Message:
        """Return the request to carry out, possibly changed, or raise ``RefusedError``."""
        raise NotImplementedError

    def secure(self, router: zmq.Socket[bytes], loop: Loop) -> None:
        """Configure the socket before it is bound."""

    def answered(self, asker: Asker, reply: m.Message) -> None:
        """Take note of a request's answer."""

    def tick(self) -> None:
        """Do periodic work; called about once a second."""

    def drain(self) -> bool:
        """Refuse new work from now on; False if this gate does not wait for running work."""
        return False

    def drained(self) -> bool:
        """Whether ``drain`` was called and no work runs any more."""
        return False

    def close(self) -> None:
        """End all sessions and undo ``secure``."""


class LocalGate(Gate):
    """Permits everything: only the user can reach the socket, in a folder of mode 0700."""

    def receive(self, router: zmq.Socket[bytes]) -> Incoming:
        """Receive the next message, which has no key."""
        identity, *frames = receive(router)
        return Incoming(identity, b"", frames)

    def greet(self, arrived: Incoming, name: bytes) -> None:
        """Permit every session."""
        self.sessions.connect(arrived.identity, arrived.key, name)

    def authorize(self, asker: Asker, request: m.Message, payload: Payload) -> m.Message:
        """Return the request unchanged."""
        return request
