"""The log of a shared server, whose size senders cannot inflate.

Each event gets a few lines per minute, then a count. Strangers share a few lines, so that noise at
the port leaves room for the lines that an operator needs. Each client has many lines of its own,
more than ordinary work writes.

One event is one line: for people, or as JSON for programs. Trust: names and reasons come from
clients, from jails and from strangers at the port. Their text is written in ASCII, with every
special character escaped, and long text is cut: a sender can neither forge a log line nor send
escape sequences to a terminal.
"""

from __future__ import annotations

import contextlib
import json
import re
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping
from datetime import datetime, timezone
from time import monotonic
from typing import Any

from envhub_worker.protocol import messages as m
from envhub_worker.protocol.keys import KEY_BYTES, key_text
from envhub_worker.protocol.text import shortage
from envhub_worker.server.sessions import WATCHER, Session
from envhub_worker.supervisor.records import Asker, JailRecord, Witness

LINES = 10
"""Most lines in a period of an event without a client's key."""
CLIENT_LINES = 600
"""Most lines in a period of one client's event."""
PERIOD_S = 60.0
LEVELS = ("debug", "info", "warning", "error")
"""The least important first."""
MAX_TEXT = 300
"""Characters of a value."""
MAX_LONG_TEXT = 8_000
"""Characters of a traceback, which is our own code's."""
_LONG = frozenset({"traceback"})
_PLAIN = re.compile(r"[A-Za-z0-9_.:/@+-]+")

Fields = Mapping[str, object]
Form = Callable[[float, str, str, Fields], str]
"""Makes a line of the time, the level, the event and what else there is to say of it."""


def text_line(when: float, level: str, event: str, fields: Fields) -> str:
    """``2026-01-31T12:00:00.000Z info jail_opened client=alice ...``"""
    words = [f"{name}={_word(_bounded(name, value))}" for name, value in fields.items()]
    return " ".join([_time(when), level, event, *words])


def json_line(when: float, level: str, event: str, fields: Fields) -> str:
    """An object with ``time``, ``level``, ``event`` and the fields, which have other names."""
    bounded = {name: _bounded(name, value) for name, value in fields.items()}
    return json.dumps({"time": _time(when), "level": level, "event": event, **bounded})


FORMS: dict[str, Form] = {"text": text_line, "json": json_line}


def _time(when: float) -> str:
    moment = datetime.fromtimestamp(when, timezone.utc).replace(tzinfo=None)
    return f"{moment.isoformat(timespec='milliseconds')}Z"


def _bounded(name: str, value: object) -> bool | int | float | str:
    """Returns a number, rounded if it is a float; any other value as text, cut to its limit."""
    if isinstance(value, float):
        return round(value, 3)
    if isinstance(value, (bool, int)):
        return value
    text, limit = str(value), MAX_LONG_TEXT if name in _LONG else MAX_TEXT
    if len(text) <= limit:
        return text
    return f"{text[:limit]}[... {len(text) - limit} characters left out]"


def _word(value: bool | int | float | str) -> str:
    if isinstance(value, str) and _PLAIN.fullmatch(value):
        return value
    return json.dumps(value)  # ASCII alone: quotes, control characters and the like are escaped


def _to_stderr(line: str) -> None:
    # closed, or a pipe without a reader: no reason to end what is served
    with contextlib.suppress(OSError, ValueError):
        print(line, file=sys.stderr, flush=True)


class Log:
    """Writes a limited number of lines of each event in ``PERIOD_S`` seconds."""

    def __init__(
        self,
        write: Callable[[str], None] = _to_stderr,
        clock: Callable[[], float] = monotonic,
        form: Form = text_line,
        level: str = "info",
    ) -> None:
        self._write = write
        self._clock = clock
        self._form = form
        self._least = LEVELS.index(level)
        self._since = clock()
        self._counts: Counter[tuple[str, str]] = Counter()

    def say(self, event: str, level: str = "warning", *, whose: str = "", **fields: object) -> None:
        """Write a line, or count it as omitted. ``whose``: the client's key, if there is one."""
        if LEVELS.index(level) < self._least:
            return
        self.tick()
        self._counts[event, whose] += 1
        if self._counts[event, whose] <= _most(whose):
            self._line(level, event, **fields)

    def tick(self) -> None:
        """At the end of a period, write how many lines were omitted."""
        if self._clock() - self._since < PERIOD_S:
            return
        for (event, whose), count in self._counts.items():
            if count > _most(whose):
                key = {"key": whose[:16]} if whose else {}
                self._line("warning", "left_out", of=event, lines=count - _most(whose), **key)
        self._counts.clear()
        self._since = self._clock()

    def _line(self, level: str, event: str, **fields: object) -> None:
        self._write(self._form(time.time(), level, event, fields))


def _most(whose: str) -> int:
    return CLIENT_LINES if whose else LINES


class Events(Witness):
    """Logs events of clients and their jails, under the names in the operator's list.

    Args:
        name_of: Returns the name of a key in the list of clients.
        count_opened: Called with a client's key when its jail has started.
    """

    def __init__(
        self,
        log: Log,
        name_of: Callable[[bytes], str | None],
        count_opened: Callable[[bytes], None],
    ) -> None:
        self._log = log
        self._name_of = name_of
        self._count_opened = count_opened
        self._in_line: set[tuple[bytes, str]] = set()

    # --- clients -------------------------------------------------------------------------------

    def came(self, session: Session) -> None:
        """Log the first ``Hello`` of a client's process."""
        self._in_line.discard((session.key, "sessions"))
        level = "debug" if session.name == WATCHER else "info"
        self._client(session.owner, "client_connected", level, key=key_text(session.key))

    def left(self, session: Session, why: str) -> None:
        """Log the end of a session."""
        self._in_line -= {entry for entry in self._in_line if entry[0] == session.owner}
        level = "debug" if session.name == WATCHER else "info"
        seconds = monotonic() - session.since
        self._client(session.owner, "client_left", level, why=why, seconds=seconds)

    def uploads(self, owner: bytes, snapshot: str, files: int, size: int) -> None:
        """Log how many files and bytes of a snapshot a client has to upload."""
        fields = {"snapshot": snapshot, "files": files, "bytes": size}
        self._client(owner, "upload", "info", **fields)

    def packages(self, owner: bytes, seconds: float, result: Mapping[str, Any]) -> None:
        """Log the end of the program that makes packages; its text quotes a client."""
        environment = result.get("made")
        fields = {name: environment[name] for name in ("name", "bytes")} if environment else {}
        if "error" in result:
            fields = {"error": result["error"], "why": result["said"]}
        level = "warning" if "error" in result else "info"
        self._client(owner, "packages", level, seconds=seconds, **fields)

    def refused(self, asker: Asker, refused: m.Refusal) -> None:
        """Log a refusal. A waiting client asks every second; only its first refusal is logged."""
        owner, level = asker.session or asker.key, "warning"
        fields: dict[str, object] = {"error": refused.error, "why": refused.message}
        if busy := refused.busy:
            fields |= {"quota": busy.quota, "used": busy.used, "limit": busy.limit}
            level = "debug" if (owner, busy.quota) in self._in_line else level
            self._in_line.add((owner, busy.quota))
        elif refused.error == "DependencyError":
            fields |= {"reason": refused.missing}
        elif refused.missing:
            fields |= {"layer": refused.missing, "fix": refused.fix}
        self._client(owner, "refused", level, **fields)

    # --- jails ---------------------------------------------------------------------------------

    def opened(self, entry: JailRecord, runners: int, seconds: float) -> None:
        """Log the start of a jail or of further runners."""
        spec = entry.jail.spec
        self._in_line -= {line for line in self._in_line if line[0] == entry.session}
        fields = {**_jail(entry), "runners": runners, "seconds": seconds}
        if entry.opened:
            self._client(entry.session, "runners_started", "info", **fields)
            return
        self._count_opened(entry.session[:KEY_BYTES])
        fields |= {
            "environment": entry.name,
            "snapshot": spec.snapshot.rpartition("/")[2],
            "profile": spec.confinement.profile,
            "memory": spec.confinement.limits.memory_bytes,
        }
        self._client(entry.session, "jail_opened", "info", **fields)

    def lost(self, entry: JailRecord, death: m.Death) -> None:
        """Log the death of a runner whose jail goes on."""
        fields = {**_jail(entry), "environment": entry.name, "runner": death.runner, **_how(death)}
        self._client(entry.session, "runner_died", "warning", **fields)

    def died(self, entry: JailRecord) -> None:
        """Log a jail's death. A jail that could not be made is logged by its refusal."""
        refused = entry.death is not None and entry.death.reason == "unavailable"
        if entry.death is not None and (entry.opened or not refused):
            fields = {**_jail(entry), "environment": entry.name, **_how(entry.death), **_use(entry)}
            self._client(entry.session, "jail_died", "warning", **fields)

    def closed(self, entry: JailRecord) -> None:
        """Log the end of a jail that its client or the server has closed."""
        fields = {**_jail(entry), "environment": entry.name, **_use(entry)}
        self._client(entry.session, "jail_closed", "info", **fields)

    def failed(self, error: Exception) -> None:
        """Log an error of the server itself; without traceback if this machine lacks a resource."""
        short = shortage(error, "here")
        if short:
            self._log.say("out_of_resources", "error", why=short)
            return
        way = "".join(traceback.format_exception(error))
        why = f"{type(error).__name__}: {error}"
        self._log.say("server_error", "error", why=why, traceback=way)

    def _client(self, owner: bytes, event: str, level: str, **more: object) -> None:
        key = owner[:KEY_BYTES]
        nameless = f"key {key_text(key)[:16]}" if any(key) else "anybody"
        session = owner[KEY_BYTES:].hex()[:8]  # as in ``envhub-worker status``: the client's choice
        who = {"client": self._name_of(key) or nameless, "session": session}
        self._log.say(event, level, whose=key_text(key), **who, **more)


def _jail(entry: JailRecord) -> dict[str, object]:
    return {"jail": f"{entry.number:016x}"}


def _how(death: m.Death) -> dict[str, object]:
    """Returns the fields of a jail's death. Trust: the detail may quote the jail."""
    fields = {
        "reason": death.reason,
        "signal": death.signal,
        "exit_code": death.exit_code,
        "detail": death.detail or None,
    }
    return {name: value for name, value in fields.items() if value is not None}


def _use(entry: JailRecord) -> dict[str, object]:
    """Returns a jail's lifetime and its bytes through the server, without shared memory."""
    sent, received = entry.bytes_moved()
    return {"seconds": monotonic() - entry.since, "bytes_in": sent, "bytes_out": received}
