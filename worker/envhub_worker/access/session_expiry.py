"""The end of sessions that nothing holds any more, and of jails whose client let go of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from envhub_worker.access.audit.events import Events
from envhub_worker.access.sessions import Session, Sessions
from envhub_worker.access.store.uploads import Uploads
from envhub_worker.supervisor.jails import Jails

_FORGOTTEN_S = 3600.0
"""Where silent clients keep their jails, those without any are forgotten after so long."""


class SessionExpiry:
    """Ends sessions of a ``RemoteGate``.

    Args:
        idle_s: How long the jails of a client that says nothing live on; 0 for ever.
        open_wires: The connections that are there now; None if they are not counted.
    """

    def __init__(
        self,
        idle_s: int,
        uploads: Uploads,
        events: Events,
        open_wires: Callable[[], frozenset[int] | None],
    ) -> None:
        self._idle_s = idle_s
        self._uploads, self._events, self._open_wires = uploads, events, open_wires

    def tick(self, sessions: Sessions, jails: Jails) -> None:
        """End the jails of clients that are not heard from, and what clients no longer hold."""
        self.end_deserted(sessions, jails)
        for session in sessions.idle(self._idle_s or _FORGOTTEN_S):
            if self._idle_s:
                why = f"its client has sent nothing for {self._idle_s} s"
                self.end(session, sessions, jails, why)
            elif not jails.open_ones(session.owner):
                self.drop(session, sessions, "it has sent nothing for too long")
        if self._idle_s:
            self._end_unheld(sessions, jails)

    def end_deserted(self, sessions: Sessions, jails: Jails) -> None:
        """Forget the connections that have gone, and the sessions that have nothing else.

        A client that is only cut off loses nothing: what it had was a name. One that has jails
        keeps them, for ``idle_s``, or until others of its key need the place.
        """
        self.disconnect(sessions)
        for session in sessions.all():
            if not session.connections and not jails.open_ones(session.owner):
                self.drop(session, sessions, "its connections have ended")

    def disconnect(self, sessions: Sessions) -> None:
        """Forget the connections that have gone."""
        wires = self._open_wires()
        if wires is not None:
            sessions.disconnect(wires)

    def _end_unheld(self, sessions: Sessions, jails: Jails) -> None:
        for session in sessions.all():
            for entry in jails.open_ones(session.owner):
                if sessions.unheld(session, entry.number, self._idle_s):
                    jails.end(entry, "its client gave it up")

    def end(self, session: Session, sessions: Sessions, jails: Jails, why: str) -> None:
        """End a session and its jails."""
        for entry in jails.open_ones(session.owner):
            jails.end(entry, why)
        self.drop(session, sessions, why)

    def drop(self, session: Session, sessions: Sessions, why: str) -> None:
        """Forget a session."""
        self._uploads.forget(session.owner)
        sessions.drop(session)
        self._events.left(session, why)


def longest_gone(sessions: Sequence[Session]) -> Session | None:
    """The session without a connection that was heard from the longest ago, if there is one."""
    gone = [one for one in sessions if not one.connections]
    return min(gone, key=lambda one: one.heard, default=None)
