"""Keys, quotas and the snapshots that clients bring along: the gate before a TCP port."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import zmq

from envhub_worker.access.departures import Departures, longest_gone
from envhub_worker.access.drain import Drain
from envhub_worker.access.gate import Arrived, Asked, Greeting, Handler
from envhub_worker.access.keys import AuthorizedClients, KeyPair
from envhub_worker.access.line import RETRY_S, Line
from envhub_worker.access.packages import Packages
from envhub_worker.access.port.connection_limit import MAX_CONNECTIONS
from envhub_worker.access.port.curve_port import CurvePort
from envhub_worker.access.quotas import (
    BusyError,
    InFlight,
    Permissions,
    Quotas,
    RefusedError,
    Use,
    check_jail,
    check_policy,
)
from envhub_worker.access.sessions import WATCHER, Sessions
from envhub_worker.access.store.uploads import PREFIX, Uploads, wrong_with_path
from envhub_worker.access.telling.events import Events
from envhub_worker.access.telling.figures import Clients, Facts, Tally, client_name
from envhub_worker.access.telling.rate_limited_log import Log
from envhub_worker.access.telling.usage import Usage
from envhub_worker.lockdown.spec import confinement_from_wire
from envhub_worker.loop import Loop
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import ProtocolError
from envhub_worker.protocol.keys import KEY_BYTES, key_text
from envhub_worker.protocol.messages.busy import Busy
from envhub_worker.protocol.records import dataclass
from envhub_worker.protocol.runtime import OWN
from envhub_worker.supervisor.jails import Jails
from envhub_worker.supervisor.records import Asker, JailEntry
from envhub_worker.supervisor.witness import Witness

_PLACE_NEEDED = "its client has gone, and its key needed the place"


@dataclass(frozen=True, kw_only=True)
class Rules:
    """How a ``RemoteGate`` is set up.

    Attributes:
        keys: The server's key pair; None only for ``--insecure-loopback``.
        operators: Keys that see everybody's sessions: the server's own.
        idle_s: How long the jails of a client that says nothing live on.
        drain_s: How long what runs may go on once nothing new is let in.
        profile: The strongest that jails can have here.
    """

    keys: KeyPair | None
    authorized: AuthorizedClients
    operators: frozenset[bytes]
    quotas: Quotas
    permissions: Permissions
    idle_s: int
    max_connections: int = MAX_CONNECTIONS
    drain_s: int = 0
    profile: str = "strict"


class RemoteGate:
    """Keys, quotas and the snapshots that clients bring along."""

    compresses = True

    def __init__(
        self,
        rules: Rules,
        uploads: Uploads,
        packages: Packages,
        log: Log,
        publish: Callable[[Mapping[str, Any]], None] | None = None,
    ) -> None:
        self.idle_s = rules.idle_s
        self._rules = rules
        self._uploads = uploads
        self._packages = packages
        self._log = log
        self._events = Events(log, self._name_of, self._count_opened)
        self.witness: Witness = self._events
        self._in_flight = InFlight()
        self._lines = {"sessions": Line(), "jails": Line()}
        self._drain = Drain(rules.drain_s)
        self._publish = publish
        self._unread = ""
        self._tally, self._usage = Tally(), Usage(self._events.failed)
        self._facts = Facts(
            profile=rules.profile,
            permissions=rules.permissions,
            quotas=rules.quotas,
            state=str(uploads.folder),
            max_connections=rules.max_connections,
        )
        self._port = CurvePort(rules.keys, self._admits, log, rules.max_connections)
        self._departures = Departures(rules.idle_s, uploads, self._events, self._port.open_wires)
        self.handlers: Mapping[type[m.Message], Handler] = {
            m.OfferSnapshot: self._offer,
            m.PutBlob: self._put,
            m.KeepAlive: self._keep,
            m.GetSessions: self._tell_sessions,
            m.NeedPackages: self._need,
        }

    # --- the socket ----------------------------------------------------------------------------

    def secure(self, router: zmq.Socket[bytes], loop: Loop) -> None:
        """CURVE, and what bounds a peer that keeps none of the rules."""
        self._port.secure(router, loop)

    def receive(self, router: zmq.Socket[bytes]) -> Arrived:
        """The key is the one that was proved in the handshake, never what the peer claims."""
        return self._port.receive(router)

    def _admits(self, key: bytes, address: str) -> bool:
        if self._rules.authorized.name_of(key) is not None or key in self._rules.operators:
            return True
        # a kind of its own: noise at the port must not count away the line that an operator needs
        self._log.say("unknown_key", key=key_text(key), address=address)
        return False

    # --- requests ------------------------------------------------------------------------------

    def greet(self, greeting: Greeting) -> None:
        """Refuse who has proved no key, and more sessions than the quota."""
        (identity, key, _, fd), name, sessions, jails = greeting
        self._refuse_unless_authorized(key)
        if len(name) > 64:
            raise RefusedError("LocalProtocolError", "the name of a session is too long")
        self._departures.end_deserted(sessions, jails)
        if name != WATCHER and name not in {one.name for one in sessions.of_key(key)}:
            self._drain.refuse_new()
        others = [one for one in sessions.of_key(key) if one.name not in (name, WATCHER)]
        quota = self._rules.quotas.sessions
        if name != WATCHER and len(others) >= quota:
            gone = longest_gone(others)
            if gone is None:
                self._lines["sessions"].wait(key, name)
                raise BusyError(
                    Busy("sessions", len(others), quota, RETRY_S),
                    f"your key has {quota} sessions, which is the server's quota (--max-sessions)",
                )
            self._departures.end(gone, sessions, jails, _PLACE_NEEDED)
        elif name not in {one.name for one in sessions.of_key(key)}:
            self._refuse_behind("sessions", key, name, len(others), quota)
        self._lines["sessions"].leave(key, name)
        wire = self._port.wire(fd)
        known = {one.name for one in sessions.of_key(key)}
        session = sessions.connect(identity, key, name, wire)
        if name not in known:
            self._events.came(session)

    def authorize(self, asked: Asked) -> m.Message:
        """Hold a request against keys and quotas."""
        asker, request = asked.asker, asked.request
        self._refuse_unless_authorized(asker.key)
        if isinstance(request, (m.OpenJail, m.OfferSnapshot, m.NeedPackages)):
            self._drain.refuse_new()
        if isinstance(request, m.OpenJail):
            return self._authorize_open(asked, request)
        if isinstance(request, m.StartRunners):
            self._find_place(asked, Use(0, request.runners))
        elif isinstance(request, m.Relay):
            asked.sessions.used(asker.identity, asker.key, request.jail)
            self._tally.asked(self._label_of(asker.key), request.operation)
            size = sum(map(len, asked.payload))
            self._in_flight.add(asker.key, asker, size, self._rules.quotas.inflight_bytes)
        return request

    def _name_of(self, key: bytes) -> str | None:
        name = self._rules.authorized.name_of(key)
        return name if name or key not in self._rules.operators else "operator"

    def _is_known(self, key: bytes) -> bool:
        rules = self._rules
        if rules.keys is None or key in rules.operators:
            return True
        return rules.authorized.name_of(key) is not None

    def _refuse_unless_authorized(self, key: bytes) -> None:
        if not self._is_known(key):
            raise RefusedError("WorkerError", "your key is not authorised any more")

    def _find_place(self, asked: Asked, more: Use) -> None:
        """Hold a jail against the quotas; those of the key's processes that have gone go first."""
        asker, sessions, jails = asked.asker, asked.sessions, asked.jails
        check_jail((), more, self._rules.quotas)  # nobody goes for what never fits
        while True:
            try:
                check_jail(_uses(jails, asker.key), more, self._rules.quotas)
            except BusyError:
                self._departures.disconnect(sessions)
                # its own may look so, too: what it said last is read after it has gone
                others = [one for one in sessions.of_key(asker.key) if one.owner != asker.session]
                gone = longest_gone(others)
                if gone is None:
                    if more.memory_bytes:
                        self._lines["jails"].wait(asker.key, asker.session)
                    raise
                self._departures.end(gone, sessions, jails, _PLACE_NEEDED)
            else:
                break
        if more.memory_bytes:
            used, quota = len(_uses(jails, asker.key)), self._rules.quotas.jails
            self._refuse_behind("jails", asker.key, asker.session, used, quota)
            self._lines["jails"].leave(asker.key, asker.session)

    def _refuse_behind(self, quota: str, key: bytes, owner: bytes, used: int, limit: int) -> None:
        """There is room, and others of the same key have waited for it."""
        line = self._lines[quota]
        ahead = line.ahead(key, owner)
        if ahead:
            line.wait(key, owner)
            text = f"{ahead} other processes of your key wait for the server's {quota}"
            raise BusyError(Busy(quota, used, limit, RETRY_S), text)

    def _authorize_open(self, asked: Asked, request: m.OpenJail) -> m.OpenJail:
        try:
            confinement = confinement_from_wire(request.confinement)
        except ProtocolError as error:
            raise RefusedError("LocalProtocolError", f"no confinement: {error}") from None
        check_policy(request, confinement, self._rules.permissions)
        wrong = wrong_with_path(request.entry)
        if wrong:
            raise RefusedError("PolicyError", f"the entry file {wrong}")
        packages = request.runtime.packages
        runtime = self._packages.runtime(asked.asker.key, packages) if packages else OWN
        self._find_place(asked, Use(confinement.limits.memory_bytes, request.runners))
        tree = self._uploads.tree(asked.asker.key, request.snapshot)
        return m.replace(
            request,
            name=request.name[:512],
            python=runtime.python,
            packages=runtime.packages,
            snapshot=tree,
        )

    def _need(self, asked: Asked) -> m.Message:
        request = asked.request
        assert isinstance(request, m.NeedPackages)
        asker = asked.asker
        return self._packages.need(asker.key, request, asked.jails.packages, asker.session)

    def _offer(self, asked: Asked) -> m.Message:
        asker, request = asked.asker, asked.request
        assert isinstance(request, m.OfferSnapshot)
        in_use = {entry.jail.spec.snapshot for entry in asked.jails.open_ones()}
        wanted = self._uploads.offer(asker.session, asker.key, request, in_use)
        if wanted.hashes:
            sizes = {file[2]: file[1] for file in request.files if isinstance(file, tuple)}
            size = sum(sizes[sha256] for sha256 in wanted.hashes)
            digest = wanted.snapshot.removeprefix(PREFIX)
            self._events.uploads(asker.session, digest, len(wanted.hashes), size)
        return wanted

    def _put(self, asked: Asked) -> m.Message:
        asker, request = asked.asker, asked.request
        assert isinstance(request, m.PutBlob)
        if len(asked.payload) != 1:
            raise RefusedError("LocalProtocolError", "PutBlob has one frame")
        self._uploads.put(asker.session, asker.key, request, asked.payload[0])
        return m.Done()

    def _keep(self, asked: Asked) -> m.Message:
        request = asked.request
        assert isinstance(request, m.KeepAlive)
        session = asked.sessions.find(asked.asker.identity, asked.asker.key)
        if session is not None and all(type(jail) is int for jail in request.jails[:4096]):
            asked.sessions.keep(session, request.jails[:4096])
        return m.Done()

    def _tell_sessions(self, asked: Asked) -> m.Message:
        asker = asked.asker
        told = self._sessions_of(asker.key, asked.sessions, asked.jails)
        return m.Sessions(tuple(told), self.figures(asked.sessions, asked.jails, asker.key))

    def answered(self, asker: Asker) -> None:
        """Its bytes are no longer in flight."""
        self._in_flight.answered(asker)

    def refused(self, asker: Asker, refused: m.Refused) -> None:
        """The operator is told, and it is counted."""
        self._tally.refused(refused.error, refused.missing)
        self._events.refused(asker, refused)

    def _count_opened(self, key: bytes) -> None:
        self._tally.open(self._label_of(key))

    def _label_of(self, key: bytes) -> str:
        return client_name(self._rules.authorized.name_of(key), self._rules.keys is None)

    def figures(self, sessions: Sessions, jails: Jails, key: bytes | None = None) -> dict[str, Any]:
        """What there is to tell: all to the operator, and to any other key what concerns it."""
        clients = Clients()
        for one in sessions.all():
            if one.name != WATCHER:
                clients.of(self._label_of(one.key)).add_session(one)
        for entry in jails.open_ones():
            clients.of(self._label_of(_key_of(entry))).add_jail(entry)
        for known in {one.key for one in sessions.all() if one.name != WATCHER}:
            share = clients.of(self._label_of(known))
            share.upload_bytes += self._uploads.used_bytes(known)
            share.inflight_bytes += self._in_flight.of(known)
        clients.add_past(self._tally, self._usage)
        told = {**self._facts.for_clients(), "draining_s": self._drain.left_s}
        if key is not None and key not in self._rules.operators:
            return {**told, "clients": clients.told(self._label_of(key))}
        looking = sum(len(one.connections) for one in sessions.all() if one.name == WATCHER)
        return {
            **told,
            **self._facts.for_operators(),
            "connections": max(0, len(self._port.open_wires() or ()) - looking),
            "waiting": {quota: line.waiting for quota, line in self._lines.items()},
            "refusals": dict(self._tally.refusals),
            "deaths": dict(jails.deaths),
            "clients": clients.told(),
        }

    def _sessions_of(self, key: bytes, sessions: Sessions, jails: Jails) -> list[dict[str, Any]]:
        rules = self._rules
        self._departures.end_deserted(sessions, jails)
        found = sessions.all() if key in rules.operators else sessions.of_key(key)
        seen = [one for one in found if one.name != WATCHER]  # whoever asks, above all
        used = {key: self._uploads.used_bytes(key) for key in {one.key for one in seen}}
        return [
            {
                "client": self._name_of(one.key) or "operator",
                "key": key_text(one.key),
                "session": one.name.hex()[:8],
                "heard_s": sessions.age_s(one),
                "connections": len(one.connections),
                "upload_bytes": used[one.key],
                "jails": tuple(jails.statuses(one.owner)),
            }
            for one in seen
        ]

    # --- time ----------------------------------------------------------------------------------

    def tick(self, sessions: Sessions, jails: Jails) -> None:
        """End the jails of clients that are not heard from, and what clients no longer hold."""
        self._log.tick()
        self._port.tick()
        self._read_clients()
        for session in sessions.all():
            if not self._is_known(session.key):
                self._departures.end(session, sessions, jails, "its key is not authorised any more")
        self._departures.tick(sessions, jails)
        self._packages.look(jails.packages)
        for news in self._packages.news():
            self._events.packages(news.owner, news.seconds, news.said)
        if self._publish is not None:
            self._publish(self.figures(sessions, jails))
        self._usage.watch(
            {
                pid: self._label_of(_key_of(entry))
                for entry in jails.open_ones()
                if (pid := entry.jail.pid) > 0
            }
        )
        if self._drain.over:
            for entry in jails.open_ones():
                jails.end(entry, f"the server ends, {self._rules.drain_s} s after it was told to")

    def _read_clients(self) -> None:
        """Once a second; what is wrong with the list is said once, until it is another."""
        try:
            changed, why = self._rules.authorized.refresh(), ""
        except (OSError, ValueError) as error:
            changed, why = False, str(error)
        if why and why != self._unread:
            self._log.say("clients_kept_as_they_were", why=why)
        elif changed:
            self._log.say("clients_read", "info", clients=self._rules.authorized.count)
        self._unread = why

    def drain(self) -> bool:
        """Refuse new sessions and jails; those that run have ``drain_s``."""
        return self._drain.begin(self._log)

    def drained(self, jails: Jails) -> bool:
        """Whether it may end: no jail is left, and everybody had a moment to hear so."""
        return self._drain.begun and self._drain.quiet(bool(jails.open_ones()))

    def close(self, sessions: Sessions) -> None:
        """Everybody has to go; close the sockets of the handshakes."""
        for session in sessions.all():
            self._departures.drop(session, sessions, "the server ends")
        self._packages.close()
        self._usage.close()
        self._port.close()


def _key_of(entry: JailEntry) -> bytes:
    """Whose a jail is: what it is marked with begins with the key, see ``Session.owner``."""
    return entry.session[:KEY_BYTES]


def _uses(jails: Jails, key: bytes) -> list[Use]:
    return [
        Use(entry.jail.spec.confinement.limits.memory_bytes, len(entry.links))
        for entry in jails.open_ones(key)
    ]
