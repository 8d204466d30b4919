"""The sessions of connected clients, and each session's connections."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Collection
from dataclasses import dataclass, field

WATCHER = b"status"
"""The session of a client that only looks: the same each time, and not counted."""

CONNECTIONS_OF_ONE = 4096
"""Most connections of one session; the longest unused one is dropped."""

MAX_HELD = 8192
"""Jails of one session whose last mention is remembered."""


@dataclass
class Connection:
    """A connection of a session.
    ``wire``: the number of the open connection, or None if the gate does not count them.
    """

    wire: int | None = None
    compression: str = ""


@dataclass
class Session:
    """One client: a process of a key's owner.

    Attributes:
        key: The client's public key, as ZAP reported it; empty without keys.
        name: The client's own random bytes.
        heard: When its last message came.
        held: The jails that it holds, each with the time of its last ``KeepAlive`` or use; None
            before the first ``KeepAlive``.
    """

    key: bytes
    name: bytes
    heard: float
    held: dict[int, float] | None = None
    connections: OrderedDict[tuple[bytes, bytes], Connection] = field(default_factory=OrderedDict)
    since: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        # The mark of the session's jails, which no client with another key can have.
        self.owner = self.key + self.name


class Sessions:
    """All sessions, and the session of each connection.

    A connection is identified by its routing id **and** its key: a peer may claim any routing id,
    but it has proved its key.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._sessions: dict[bytes, Session] = {}  # by owner
        self._of: dict[tuple[bytes, bytes], Session] = {}  # by (routing id, key)

    def all(self) -> list[Session]:
        """Returns every session."""
        return list(self._sessions.values())

    def of_key(self, key: bytes) -> list[Session]:
        """Returns every session of a key."""
        return [session for session in self._sessions.values() if session.key == key]

    def connect(self, identity: bytes, key: bytes, name: bytes, wire: int | None = None) -> Session:
        """Add a connection to the session of this name; makes a new session if there is none."""
        session = self._sessions.get(key + name)
        if session is None:
            session = self._sessions[key + name] = Session(key, name, self._clock())
        self._disconnect((identity, key))
        self._of[identity, key] = session
        session.connections[identity, key] = Connection(wire)
        if len(session.connections) > CONNECTIONS_OF_ONE:
            self._disconnect(next(iter(session.connections)))
        return session

    def _disconnect(self, connection: tuple[bytes, bytes]) -> None:
        session = self._of.pop(connection, None)
        if session is not None:
            session.connections.pop(connection, None)

    def disconnect(self, wires: Collection[int]) -> None:
        """Forget all connections except these."""
        for session in self._sessions.values():
            for name, connection in list(session.connections.items()):
                if connection.wire is not None and connection.wire not in wires:
                    self._disconnect(name)

    def find(self, identity: bytes, key: bytes) -> Session | None:
        """Returns the session of a connection whose message has just come."""
        connection = identity, key
        session = self._of.get(connection)
        if session is not None:
            session.heard = self._clock()
            session.connections.move_to_end(connection)
        return session

    def agree(self, identity: bytes, key: bytes, compression: str) -> None:
        """Allow compression of a connection's frames from now on."""
        self._of[identity, key].connections[identity, key].compression = compression

    def compression(self, identity: bytes, key: bytes) -> str:
        """Returns a connection's compression; empty for none."""
        session = self._of.get((identity, key))
        return "" if session is None else session.connections[identity, key].compression

    def idle(self, idle_s: float) -> list[Session]:
        """Returns the sessions that were silent for ``idle_s``."""
        now = self._clock()
        return [session for session in self._sessions.values() if now - session.heard > idle_s]

    def drop(self, session: Session) -> None:
        """Forget a session and its connections."""
        for connection in list(session.connections):
            self._disconnect(connection)
        self._sessions.pop(session.owner, None)

    def keep(self, session: Session, jails: tuple[int, ...]) -> None:
        """Record which jails the client holds."""
        now = self._clock()
        listed = dict.fromkeys(jails, now)
        before = [item for item in (session.held or {}).items() if item[0] not in listed]
        session.held = dict([*before, *listed.items()][-MAX_HELD:])

    def used(self, identity: bytes, key: bytes, jail: int) -> None:
        """Record that a connection uses a jail: its client holds it, even without ``KeepAlive``."""
        session = self._of.get((identity, key))
        if session is not None and session.held is not None and jail in session.held:
            session.held[jail] = self._clock()

    def unheld(self, session: Session, jail: int, idle_s: float) -> bool:
        """Whether the client has not held the jail for ``idle_s``; starts the clock if need be."""
        if session.held is None:
            return False
        return self._clock() - session.held.setdefault(jail, self._clock()) > idle_s
