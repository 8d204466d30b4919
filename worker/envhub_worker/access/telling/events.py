"""What a server that many share writes down of clients and their jails."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from time import monotonic
from typing import Any

from envhub_worker.access.sessions import WATCHER, Session
from envhub_worker.access.telling.rate_limited_log import Log
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.keys import KEY_BYTES, key_text
from envhub_worker.protocol.messages import busy
from envhub_worker.protocol.messages.busy import Busy
from envhub_worker.protocol.text import shortage
from envhub_worker.supervisor.records import Asker, JailEntry


class Events:
    """A line an event, under the name that the operator has given the client.

    Args:
        log: Takes them.
        name_of: The name that stands beside a key in the list of clients.
        count_opened: Called with the key whose jail has come up.
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
        """A client's process has said Hello for the first time."""
        self._in_line.discard((session.key, "sessions"))
        level = "debug" if session.name == WATCHER else "info"
        self._client(session.owner, "client_connected", level, key=key_text(session.key))

    def left(self, session: Session, why: str) -> None:
        """Its session is forgotten."""
        self._in_line -= {one for one in self._in_line if one[0] == session.owner}
        level = "debug" if session.name == WATCHER else "info"
        seconds = monotonic() - session.since
        self._client(session.owner, "client_left", level, why=why, seconds=seconds)

    def uploads(self, owner: bytes, snapshot: str, files: int, size: int) -> None:
        """A client is to bring so many files and bytes, which the server lacks of a snapshot."""
        told = {"snapshot": snapshot, "files": files, "bytes": size}
        self._client(owner, "upload", "info", **told)

    def packages(self, owner: bytes, seconds: float, said: Mapping[str, Any]) -> None:
        """The program that makes packages has ended; what it says quotes a client."""
        made = said.get("made")
        told = {name: made[name] for name in ("name", "bytes")} if made else {}
        if "error" in said:
            told = {"error": said["error"], "why": said["said"]}
        level = "warning" if "error" in said else "info"
        self._client(owner, "packages", level, seconds=seconds, **told)

    def refused(self, asker: Asker, refused: m.Refused) -> None:
        """A request was not done. Who waits in line asks every second: that is said once."""
        owner, level = asker.session or asker.key, "warning"
        told: dict[str, object] = {"error": refused.error, "why": refused.message}
        if refused.error == busy.ERROR:
            found = Busy.read(refused.missing, refused.fix)
            told |= {"quota": found.quota, "used": found.used, "limit": found.limit}
            level = "debug" if (owner, found.quota) in self._in_line else level
            self._in_line.add((owner, found.quota))
        elif refused.missing:
            told |= {"layer": refused.missing, "fix": refused.fix}
        self._client(owner, "refused", level, **told)

    # --- jails: the supervisor's witness -------------------------------------------------------

    def opened(self, entry: JailEntry, runners: int, seconds: float) -> None:
        """A jail has come up, or further runners in it."""
        spec = entry.jail.spec
        self._in_line -= {one for one in self._in_line if one[0] == entry.session}
        told = {**_jail(entry), "runners": runners, "seconds": seconds}
        if entry.opened:
            self._client(entry.session, "runners_started", "info", **told)
            return
        self._count_opened(entry.session[:KEY_BYTES])
        told |= {
            "environment": entry.name,
            "snapshot": spec.snapshot.rpartition("/")[2],
            "profile": spec.confinement.profile,
            "memory": spec.confinement.limits.memory_bytes,
        }
        self._client(entry.session, "jail_opened", "info", **told)

    def lost(self, entry: JailEntry, death: m.Died) -> None:
        """A runner has died in a jail that goes on."""
        told = {**_jail(entry), "environment": entry.name, "runner": death.runner, **_how(death)}
        self._client(entry.session, "runner_died", "warning", **told)

    def died(self, entry: JailEntry) -> None:
        """A jail is dead; where it could not be made, its refusal says so."""
        refused = entry.death is not None and entry.death.reason == "unavailable"
        if entry.death is not None and (entry.opened or not refused):
            told = {**_jail(entry), "environment": entry.name, **_how(entry.death), **_use(entry)}
            self._client(entry.session, "jail_died", "warning", **told)

    def closed(self, entry: JailEntry) -> None:
        """Nothing is left of a jail that its client has closed, or that the server ends with."""
        told = {**_jail(entry), "environment": entry.name, **_use(entry)}
        self._client(entry.session, "jail_closed", "info", **told)

    def failed(self, error: Exception) -> None:
        """Our own mistake, with the way to it; what this machine has no more of is none."""
        short = shortage(error, "here")
        if short:
            self._log.say("out_of_resources", "error", why=short)
            return
        way = "".join(traceback.format_exception(error))
        why = f"{type(error).__name__}: {error}"
        self._log.say("server_error", "error", why=why, traceback=way)

    def _client(self, owner: bytes, event: str, level: str, **fields: object) -> None:
        key = owner[:KEY_BYTES]
        who = {"client": self._name_of(key) or _nameless(key), "session": session_id(owner)}
        self._log.say(event, level, whose=key_text(key), **who, **fields)


def session_id(owner: bytes) -> str:
    """As ``envhub-worker status`` has it; a client chooses it."""
    return owner[KEY_BYTES:].hex()[:8]


def _nameless(key: bytes) -> str:
    return f"key {key_text(key)[:16]}" if any(key) else "anybody"


def _jail(entry: JailEntry) -> dict[str, object]:
    return {"jail": f"{entry.number:016x}"}


def _how(death: m.Died) -> dict[str, object]:
    """Trust: the detail may quote a jail."""
    told = {
        "reason": death.reason,
        "signal": death.signal,
        "exit_code": death.exit_code,
        "detail": death.detail or None,
    }
    return {name: value for name, value in told.items() if value is not None}


def _use(entry: JailEntry) -> dict[str, object]:
    """Over the server; what goes through shared memory is not counted."""
    sent, received = entry.bytes_moved()
    return {"seconds": monotonic() - entry.since, "bytes_in": sent, "bytes_out": received}
