"""Admits clients' sessions and jails within the quotas of their keys, and ends them.

The processes of one key are served in the order in which they came. A session ends when nothing
holds it any more; a session whose process has ended also ends when another needs its place. A
draining server has no room.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter

from envhub_worker.extras.access.audit.log import Events, Log
from envhub_worker.extras.access.quotas import RETRY_S, BusyError, Quotas, Use, check_jail, use_of
from envhub_worker.extras.access.store.uploads import Uploads
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.messages.server import DRAINING, Busy
from envhub_worker.server.sessions import WATCHER, Session, Sessions
from envhub_worker.supervisor.jails import Jails
from envhub_worker.supervisor.records import Asker

_PATIENCE_S = 5.0
_MAX_WAITING = 1024
_PLACE_NEEDED = "its client is gone, and its key needed the place"
_FORGOTTEN_S = 3600.0
"""Where ``idle_s`` is 0, a silent client without jails is forgotten after so long."""
_QUIET_S = 1.0
"""How long a draining server waits after its last jail, so that its client can ask why it ended."""


@dataclass
class _Waiting:
    asked: float
    times: int = 1


class Line:
    """Clients in the order of their first request, as long as they repeat it.

    A client that has asked only once may not want to wait, so it delays no other client.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._waiting: dict[bytes, OrderedDict[bytes, _Waiting]] = {}

    @property
    def waiting(self) -> int:
        """Returns how many clients wait: those that have asked more than once, and recently."""
        now = self._clock()
        return sum(
            client.times > 1 and now - client.asked <= _PATIENCE_S
            for waiting in self._waiting.values()
            for client in waiting.values()
        )

    def ahead(self, key: bytes, owner: bytes) -> int:
        """Returns how many waiting clients came before this one."""
        waiting, now = self._waiting.get(key, OrderedDict()), self._clock()
        for name, client in list(waiting.items()):
            if now - client.asked > _PATIENCE_S:
                del waiting[name]
        before = 0
        for name, client in waiting.items():
            if name == owner:
                break
            before += client.times > 1
        return before

    def wait(self, key: bytes, owner: bytes) -> None:
        """Note that a client was told to ask again."""
        waiting = self._waiting.setdefault(key, OrderedDict())
        client = waiting.get(owner)
        if client is not None:
            client.asked, client.times = self._clock(), client.times + 1
        elif len(waiting) < _MAX_WAITING:
            waiting[owner] = _Waiting(self._clock())

    def leave(self, key: bytes, owner: bytes) -> None:
        """Remove an admitted client."""
        waiting = self._waiting.get(key, OrderedDict())
        waiting.pop(owner, None)
        if not waiting:
            self._waiting.pop(key, None)


class Places:
    """Checks sessions and jails against the quotas, and ends those that clients have left.

    Args:
        idle_s: How long the jails of a silent client live; 0 for ever.
        open_wires: Returns the open connections.

    Attributes:
        lines: The clients that wait, by quota.
    """

    def __init__(
        self,
        quotas: Quotas,
        idle_s: int,
        sessions: Sessions,
        jails: Jails,
        uploads: Uploads,
        events: Events,
        open_wires: Callable[[], frozenset[int]],
    ) -> None:
        self._quotas, self._idle_s = quotas, idle_s
        self._sessions, self._jails = sessions, jails
        self._uploads, self._events, self._open_wires = uploads, events, open_wires
        self.lines = {"sessions": Line(), "jails": Line()}

    def for_session(self, key: bytes, name: bytes) -> None:
        """Raise ``BusyError`` if a key has too many sessions."""
        of_key = self._sessions.of_key(key)
        others = [session for session in of_key if session.name not in (name, WATCHER)]
        quota = self._quotas.sessions
        if name != WATCHER and len(others) >= quota:
            gone = longest_gone(others)
            if gone is None:
                self.lines["sessions"].wait(key, name)
                raise BusyError(
                    Busy("sessions", len(others), quota, RETRY_S),
                    f"your key has {quota} sessions, which is the server's quota (--max-sessions)",
                )
            self.end(gone, _PLACE_NEEDED)
        elif name not in {session.name for session in of_key}:
            self._refuse_behind("sessions", key, name, len(others), quota)
        self.lines["sessions"].leave(key, name)

    def for_jail(self, asker: Asker, more: Use) -> None:
        """Raise ``BusyError`` if a jail, or further runners of one, would be over the quotas."""
        key = asker.key
        check_jail((), more, self._quotas)  # no session ends for what never fits
        while True:
            try:
                check_jail(self._uses(key), more, self._quotas)
                break
            except BusyError:
                self._sessions.disconnect(self._open_wires())
                # The asker's own session may look abandoned, too: a message may outlive its sender.
                sessions = self._sessions.of_key(key)
                gone = longest_gone([other for other in sessions if other.owner != asker.session])
                if gone is None:
                    if "jails" in more:
                        self.lines["jails"].wait(key, asker.session)
                    raise
                self.end(gone, _PLACE_NEEDED)
        if "jails" in more:
            used, quota = len(self._uses(key)), self._quotas.jails
            self._refuse_behind("jails", key, asker.session, used, quota)
            self.lines["jails"].leave(key, asker.session)

    def for_slabs(self, asker: Asker, request: m.ShareSlabs) -> None:
        """Check new slabs, some of which replace others, against the quota of memory.

        Steps work without slabs, so no session ends or waits for them.
        """
        parts = [part for part in request.slabs if type(part) is tuple and len(part) == 4]
        replaced = {part[0] for part in parts if type(part[0]) is int}
        sizes = [size for part in parts for size in part[2:] if type(size) is int and size > 0]
        for entry in self._jails.open_ones(asker.session):
            if entry.number == request.jail:
                more = sum(sizes) + entry.shared_bytes(replaced) - entry.shared_bytes()
                more_use = {"memory_bytes": max(more, 0)}
                check_jail(self._uses(asker.key), more_use, self._quotas)

    def _uses(self, key: bytes) -> list[Use]:
        return [
            use_of(entry.jail.spec.confinement.limits, len(entry.links), entry.shared_bytes())
            for entry in self._jails.open_ones(key)
        ]

    def _refuse_behind(self, quota: str, key: bytes, owner: bytes, used: int, limit: int) -> None:
        """Raise ``BusyError`` if others of the same key have waited longer for the room."""
        line = self.lines[quota]
        ahead = line.ahead(key, owner)
        if ahead:
            line.wait(key, owner)
            text = f"{ahead} other processes of your key wait for the server's {quota}"
            raise BusyError(Busy(quota, used, limit, RETRY_S), text)

    # --- ends ----------------------------------------------------------------------------------

    def tick(self) -> None:
        """End the jails of silent clients, and jails that their clients no longer hold."""
        self.end_deserted()
        # First: a client that times out in the loop below would otherwise be logged as having
        # released its jails.
        sessions = self._sessions.all() if self._idle_s else []
        given_up = [
            entry
            for session in sessions
            for entry in self._jails.open_ones(session.owner)
            if self._sessions.unheld(session, entry.number, self._idle_s)
        ]
        for session in self._sessions.idle(self._idle_s or _FORGOTTEN_S):
            if self._idle_s:
                self.end(session, f"its client has sent nothing for {self._idle_s} s")
            elif not self._jails.open_ones(session.owner):
                self.drop(session, "it has sent nothing for too long")
        for entry in given_up:
            self._jails.end(entry, "its client gave it up")

    def end_deserted(self) -> None:
        """Forget closed connections, and sessions without jails that had no other connection.

        A client that was only cut off loses nothing but a name. If it has jails, it keeps them for
        ``idle_s``, or until other clients of its key need the place.
        """
        self._sessions.disconnect(self._open_wires())
        for session in self._sessions.all():
            if not session.connections and not self._jails.open_ones(session.owner):
                self.drop(session, "its connections have ended")

    def end(self, session: Session, why: str) -> None:
        """End a session and its jails."""
        for entry in self._jails.open_ones(session.owner):
            self._jails.end(entry, why)
        self.drop(session, why)

    def drop(self, session: Session, why: str) -> None:
        """Forget a session."""
        self._uploads.forget(session.owner)
        self._sessions.drop(session)
        self._events.left(session, why)


def longest_gone(sessions: Sequence[Session]) -> Session | None:
    """Returns the disconnected session that was silent for longest, if there is one."""
    gone = [session for session in sessions if not session.connections]
    return min(gone, key=attrgetter("heard"), default=None)


class Drain:
    """The state of a server that was asked to end.
    ``drain_s``: how long open jails may go on; 0 does not wait.
    """

    def __init__(self, drain_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._drain_s = drain_s
        self._clock = clock
        self._until: float | None = None
        self._quiet_since: float | None = None

    @property
    def left_s(self) -> float | None:
        """Seconds that open jails have left; None before the drain begins."""
        return None if self._until is None else max(0.0, self._until - self._clock())

    def begin(self, log: Log) -> bool:
        """Begin to drain; False if open jails get no time, or the drain had begun."""
        if not self._drain_s or self._until is not None:
            return False
        self._until = self._clock() + self._drain_s
        log.say("draining", "info", seconds=self._drain_s)
        return True

    def quiet(self, busy: bool) -> bool:
        """Whether no jail is open and clients had a moment to notice. ``busy``: a jail is open."""
        now = self._clock()
        if busy or self._quiet_since is None:
            self._quiet_since = None if busy else now
            return False
        return now - self._quiet_since >= _QUIET_S

    def refuse_new(self) -> None:
        """Raise ``BusyError`` once the drain has begun."""
        if self._until is not None:
            raise BusyError(
                Busy(DRAINING, 0, 0, RETRY_S),
                "the server is ending and takes no new work: try again when its replacement runs",
            )
