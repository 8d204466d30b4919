"""Room for a client's sessions and jails, within the quotas of its key.

First come, first served, among the processes of one key. The sessions of processes that have gone
are ended where their place is needed.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from envhub_worker.access.quotas import RETRY_S, BusyError, Quotas, Use, check_jail
from envhub_worker.access.session_expiry import SessionExpiry, longest_gone
from envhub_worker.access.sessions import WATCHER, Sessions
from envhub_worker.protocol.messages.server import Busy
from envhub_worker.supervisor.jails import Jails
from envhub_worker.supervisor.records import Asker

_PATIENCE_S = 5.0
_MAX_WAITING = 1024
_PLACE_NEEDED = "its client is gone, and its key needed the place"


@dataclass
class _Waiting:
    asked: float
    times: int = 1


class Line:
    """The order in which clients first asked, as long as they go on asking.

    A client that has asked once may not mean to wait, and so delays no other; one that asks again
    does.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._waiting: dict[bytes, OrderedDict[bytes, _Waiting]] = {}

    @property
    def waiting(self) -> int:
        """How many mean to wait: they have asked more than once, and not long ago."""
        now = self._clock()
        return sum(
            one.times > 1 and now - one.asked <= _PATIENCE_S
            for waiting in self._waiting.values()
            for one in waiting.values()
        )

    def ahead(self, key: bytes, owner: bytes) -> int:
        """How many wait that have come before."""
        waiting, now = self._waiting.get(key, OrderedDict()), self._clock()
        for name in [name for name, one in waiting.items() if now - one.asked > _PATIENCE_S]:
            del waiting[name]
        before = 0
        for name, one in waiting.items():
            if name == owner:
                break
            before += one.times > 1
        return before

    def wait(self, key: bytes, owner: bytes) -> None:
        """A client is to ask again."""
        waiting = self._waiting.setdefault(key, OrderedDict())
        known = waiting.get(owner)
        if known is not None:
            known.asked, known.times = self._clock(), known.times + 1
        elif len(waiting) < _MAX_WAITING:
            waiting[owner] = _Waiting(self._clock())

    def leave(self, key: bytes, owner: bytes) -> None:
        """A client has been let in."""
        waiting = self._waiting.get(key, OrderedDict())
        waiting.pop(owner, None)
        if not waiting:
            self._waiting.pop(key, None)


class Places:
    """Finds a place, or raises ``BusyError``. ``lines``: the clients that wait, by quota."""

    def __init__(self, quotas: Quotas, expiry: SessionExpiry) -> None:
        self._quotas, self._expiry = quotas, expiry
        self.lines = {"sessions": Line(), "jails": Line()}

    def for_session(self, key: bytes, name: bytes, sessions: Sessions, jails: Jails) -> None:
        """Hold a session against the quota."""
        others = [one for one in sessions.of_key(key) if one.name not in (name, WATCHER)]
        quota = self._quotas.sessions
        if name != WATCHER and len(others) >= quota:
            gone = longest_gone(others)
            if gone is None:
                self.lines["sessions"].wait(key, name)
                raise BusyError(
                    Busy("sessions", len(others), quota, RETRY_S),
                    f"your key has {quota} sessions, which is the server's quota (--max-sessions)",
                )
            self._expiry.end(gone, sessions, jails, _PLACE_NEEDED)
        elif name not in {one.name for one in sessions.of_key(key)}:
            self._refuse_behind("sessions", key, name, len(others), quota)
        self.lines["sessions"].leave(key, name)

    def for_jail(self, asker: Asker, more: Use, sessions: Sessions, jails: Jails) -> None:
        """Hold a jail, or further runners of one, against the quotas."""
        key = asker.key
        check_jail((), more, self._quotas)  # no session ends for what never fits
        while True:
            try:
                check_jail(_uses(jails, key), more, self._quotas)
                break
            except BusyError:
                self._expiry.disconnect(sessions)
                # its own may look so, too: what it said last is read after it has gone
                others = [one for one in sessions.of_key(key) if one.owner != asker.session]
                gone = longest_gone(others)
                if gone is None:
                    if more.memory_bytes:
                        self.lines["jails"].wait(key, asker.session)
                    raise
                self._expiry.end(gone, sessions, jails, _PLACE_NEEDED)
        if more.memory_bytes:
            used, quota = len(_uses(jails, key)), self._quotas.jails
            self._refuse_behind("jails", key, asker.session, used, quota)
            self.lines["jails"].leave(key, asker.session)

    def _refuse_behind(self, quota: str, key: bytes, owner: bytes, used: int, limit: int) -> None:
        """There is room, and others of the same key have waited for it."""
        line = self.lines[quota]
        ahead = line.ahead(key, owner)
        if ahead:
            line.wait(key, owner)
            text = f"{ahead} other processes of your key wait for the server's {quota}"
            raise BusyError(Busy(quota, used, limit, RETRY_S), text)


def _uses(jails: Jails, key: bytes) -> list[Use]:
    return [
        Use(entry.jail.spec.confinement.limits.memory_bytes, len(entry.links))
        for entry in jails.open_ones(key)
    ]
