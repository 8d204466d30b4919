"""The gate of a TCP port: checks clients' keys and quotas, and holds their snapshots."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from time import monotonic, time
from typing import Any

import zmq

from envhub_worker.extras.access.audit.figures import (
    ClientFigures,
    Tally,
    Usage,
    client_name,
    facts_for_clients,
    facts_for_operators,
)
from envhub_worker.extras.access.audit.log import Events, Log
from envhub_worker.extras.access.curve_port import CurvePort
from envhub_worker.extras.access.packages import Packages
from envhub_worker.extras.access.places import Drain, Places
from envhub_worker.extras.access.quotas import InFlight, Rules, check_policy, use_of
from envhub_worker.extras.access.store.uploads import PREFIX, Uploads, wrong_with_path
from envhub_worker.extras.surroundings import own_runtime
from envhub_worker.lockdown.spec import confinement_from_wire
from envhub_worker.loop import Loop
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import ProtocolError
from envhub_worker.protocol.keys import KEY_BYTES, key_text
from envhub_worker.server.gate import Gate, Incoming, Payload
from envhub_worker.server.sessions import WATCHER, Sessions
from envhub_worker.supervisor.jails import Jails
from envhub_worker.supervisor.records import Asker, JailRecord, RefusedError


class RemoteGate(Gate):
    """Checks clients' keys and quotas, and holds their snapshots."""

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
        self._events = self.witness = Events(log, self._name_of, self._count_opened)
        self._in_flight = InFlight()
        self._drain = Drain(rules.drain_s)
        self._publish = publish
        self._unread = ""
        self._tally, self._usage = Tally(), Usage(self._events.failed)
        self._started = time()
        self.handlers = {
            m.OfferSnapshot: self._offer,
            m.PutBlob: self._put,
            m.KeepAlive: self._keep,
            m.GetSessions: self._list_sessions,
            m.NeedPackages: self._need,
        }

    def begin(self, sessions: Sessions, jails: Jails) -> None:
        """Set up the places for sessions and jails."""
        super().begin(sessions, jails)
        rules, wires = self._rules, self._open_wires
        self._places = Places(
            rules.quotas, rules.idle_s, sessions, jails, self._uploads, self._events, wires
        )

    # --- the socket ----------------------------------------------------------------------------

    def secure(self, router: zmq.Socket[bytes], loop: Loop) -> None:
        """Set up CURVE and the bounds on connections."""
        rules = self._rules
        limits = self._log, rules.max_connections
        self._port = CurvePort(router, loop, rules.keys, self._admits, *limits)

    def _open_wires(self) -> frozenset[int]:
        return self._port.connections.open_wires()

    def receive(self, router: zmq.Socket[bytes]) -> Incoming:
        """Receive a message; its key is the one proved in the handshake, not a peer's claim."""
        return self._port.receive(router)

    def _admits(self, key: bytes, address: str) -> bool:
        if self._is_known(key):
            return True
        # An event of its own: noise at the port must not use up the lines that an operator needs.
        self._log.say("unknown_key", key=key_text(key), address=address)
        return False

    # --- requests ------------------------------------------------------------------------------

    def greet(self, arrived: Incoming, name: bytes) -> None:
        """Refuse a sender without an authorized key, and more sessions than the quota."""
        key = arrived.key
        self._refuse_unless_authorized(key)
        if len(name) > 64:
            raise RefusedError("LocalProtocolError", "the name of a session is too long")
        self._places.end_deserted()
        is_new = name not in {session.name for session in self.sessions.of_key(key)}
        if name != WATCHER and is_new:
            self._drain.refuse_new()
        self._places.for_session(key, name)
        header, connections = arrived.header, self._port.connections
        wire = None if header is None else connections.wire(header)
        session = self.sessions.connect(arrived.identity, key, name, wire)
        if is_new:
            self._events.came(session)

    def authorize(self, asker: Asker, request: m.Message, payload: Payload) -> m.Message:
        """Check a request against keys and quotas."""
        self._refuse_unless_authorized(asker.key)
        if type(request) is m.Relay:  # first: most requests are steps
            self.sessions.used(asker.identity, asker.key, request.jail)
            self._tally.asked(self._label_of(asker.key), request.operation)
            size = len(payload[0]) if len(payload) == 1 else sum(map(len, payload))
            self._in_flight.add(asker.key, asker, size, self._rules.quotas.inflight_bytes)
            return request
        if isinstance(request, (m.OpenJail, m.OfferSnapshot, m.NeedPackages)):
            self._drain.refuse_new()
        if isinstance(request, m.OpenJail):
            return self._authorize_open(asker, request)
        if isinstance(request, m.StartRunners):
            self._places.for_jail(asker, {"runners": request.runners})
        elif isinstance(request, m.ShareSlabs):
            self._places.for_slabs(asker, request)
        return request

    def _name_of(self, key: bytes) -> str | None:
        name = self._rules.authorized.name_of(key)
        return name if name or key not in self._rules.operators else "operator"

    def _count_opened(self, key: bytes) -> None:
        self._tally.open(self._label_of(key))

    def _is_known(self, key: bytes) -> bool:
        rules = self._rules
        if rules.keys is None or key in rules.operators:
            return True
        return rules.authorized.name_of(key) is not None

    def _refuse_unless_authorized(self, key: bytes) -> None:
        if not self._is_known(key):
            raise RefusedError("WorkerError", "your key is not authorised any more")

    def _authorize_open(self, asker: Asker, request: m.OpenJail) -> m.OpenJail:
        key = asker.key
        try:
            confinement = confinement_from_wire(request.confinement)
        except ProtocolError as error:
            raise RefusedError("LocalProtocolError", f"malformed confinement: {error}") from None
        check_policy(request, confinement, self._rules.permissions)
        wrong = wrong_with_path(request.entry)
        if wrong:
            raise RefusedError("PolicyError", f"the entry file {wrong}")
        packages = request.runtime.packages
        runtime = self._packages.runtime(key, packages) if packages else own_runtime()
        use = use_of(confinement.limits, request.runners)
        copies = self._hub_copies(key, request)
        self._places.for_jail(asker, use)
        return m.replace(
            request,
            name=request.name[:512],
            python=runtime.python,
            packages=runtime.packages,
            snapshot=self._uploads.tree(key, request.snapshot),
            hub_copies=copies,
        )

    def _hub_copies(self, key: bytes, request: m.OpenJail) -> tuple[object, ...]:
        """Returns the request's Hub copies with the paths of this client's uploaded snapshots."""
        try:
            trees = {copy.tree for copy in request.repositories if copy.tree}
        except ProtocolError as error:
            raise RefusedError("LocalProtocolError", str(error)) from None
        return request.with_trees({tree: self._uploads.tree(key, tree) for tree in trees})

    def _need(self, asker: Asker, request: m.NeedPackages, payload: Payload) -> m.Message:
        return self._packages.need(asker.key, request, self.jails.packages, asker.session)

    def _offer(self, asker: Asker, request: m.OfferSnapshot, payload: Payload) -> m.Message:
        specs = [entry.jail.spec for entry in self.jails.open_ones()]
        in_use = {spec.snapshot for spec in specs}
        in_use |= {copy.tree for spec in specs for copy in spec.hub_copies}
        missing = self._uploads.offer(asker.session, asker.key, request, in_use)
        if missing.hashes:
            sizes = {file[2]: file[1] for file in request.files if isinstance(file, tuple)}
            size = sum(sizes[sha256] for sha256 in missing.hashes)
            digest = missing.snapshot.removeprefix(PREFIX)
            self._events.uploads(asker.session, digest, len(missing.hashes), size)
        return missing

    def _put(self, asker: Asker, request: m.PutBlob, payload: Payload) -> m.Message:
        if len(payload) != 1:
            raise RefusedError("LocalProtocolError", "PutBlob does not have exactly one frame")
        self._uploads.put(asker.session, asker.key, request, payload[0])
        return m.Done()

    def _keep(self, asker: Asker, request: m.KeepAlive, payload: Payload) -> m.Message:
        session = self.sessions.find(asker.identity, asker.key)
        if session is not None and all(type(jail) is int for jail in request.jails[:4096]):
            self.sessions.keep(session, request.jails[:4096])
        return m.Done()

    def answered(self, asker: Asker, reply: m.Message) -> None:
        """Stop counting a request's bytes as in flight; count and log a refusal."""
        self._in_flight.answered(asker)
        if isinstance(reply, m.Refusal):
            self._tally.refused(reply.error, reply.missing)
            self._events.refused(asker, reply)

    def _label_of(self, key: bytes) -> str:
        return client_name(self._rules.authorized.name_of(key), self._rules.keys is None)

    def figures(self, key: bytes | None = None) -> dict[str, Any]:
        """Returns the server's figures: all for an operator, else those of the key only."""
        clients = ClientFigures()
        sessions = [session for session in self.sessions.all() if session.name != WATCHER]
        watchers = [session for session in self.sessions.all() if session.name == WATCHER]
        for session in sessions:
            clients.of(self._label_of(session.key)).sessions += 1
        for entry in self.jails.open_ones():
            share = clients.of(self._label_of(_key_of(entry)))
            share.jails += 1
            share.runners += len(entry.links)
            share.memory_limit_bytes += entry.jail.spec.confinement.limits.memory_bytes
        for client_key in {session.key for session in sessions}:
            share = clients.of(self._label_of(client_key))
            share.upload_bytes += self._uploads.used_bytes(client_key)
            share.inflight_bytes += self._in_flight.of(client_key)
        clients.add_past(self._tally, self._usage)
        facts = {**facts_for_clients(self._rules), "draining_s": self._drain.left_s}
        if key is not None and key not in self._rules.operators:
            return {**facts, "clients": clients.plain(self._label_of(key))}
        looking = sum(len(session.connections) for session in watchers)
        return {
            **facts,
            **facts_for_operators(self._rules, str(self._uploads.folder)),
            "started": self._started,
            "connections": max(0, len(self._open_wires()) - looking),
            "waiting": {quota: line.waiting for quota, line in self._places.lines.items()},
            "refusals": dict(self._tally.refusals),
            "deaths": dict(self.jails.deaths),
            "clients": clients.plain(),
        }

    def _list_sessions(self, asker: Asker, request: m.GetSessions, payload: Payload) -> m.Message:
        self._places.end_deserted()
        all_of_them = asker.key in self._rules.operators
        sessions = self.sessions.all() if all_of_them else self.sessions.of_key(asker.key)
        listed = tuple(
            {
                "client": self._name_of(session.key) or "operator",
                "key": key_text(session.key),
                "session": session.name.hex()[:8],
                "heard_s": monotonic() - session.heard,
                "connections": len(session.connections),
                "upload_bytes": self._uploads.used_bytes(session.key),
                "jails": tuple(self.jails.statuses(session.owner)),
            }
            for session in sessions
            if session.name != WATCHER  # the one that asks, above all
        )
        return m.Sessions(listed, self.figures(asker.key))

    # --- time ----------------------------------------------------------------------------------

    def tick(self) -> None:
        """End the jails of silent clients, and jails that their clients no longer hold."""
        self._log.tick()
        self._port.connections.tick()
        self._read_clients()
        for session in self.sessions.all():
            if not self._is_known(session.key):
                self._places.end(session, "its key is not authorised any more")
        self._places.tick()
        self._packages.look(self.jails.packages)
        for news in self._packages.news():
            self._events.packages(*news)
        if self._publish is not None:
            self._publish(self.figures())
        watched = {
            entry.jail.pid: self._label_of(_key_of(entry)) for entry in self.jails.open_ones()
        }
        self._usage.watch({pid: label for pid, label in watched.items() if pid > 0})
        if self._drain.left_s == 0.0:
            for entry in self.jails.open_ones():
                why = f"the server ends, {self._rules.drain_s} s after it was asked to"
                self.jails.end(entry, why)

    def _read_clients(self) -> None:
        """Read the list of clients if it has changed; log each problem once."""
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
        """Refuse new sessions and jails; open ones may go on for ``drain_s``."""
        return self._drain.begin(self._log)

    def drained(self) -> bool:
        """Whether the server may end: no jail is open, and clients had a moment to notice."""
        return self._drain.left_s is not None and self._drain.quiet(bool(self.jails.open_ones()))

    def close(self) -> None:
        """End all sessions; close the sockets of the handshakes."""
        for session in self.sessions.all():
            self._places.drop(session, "the server ends")
        self._packages.close()
        self._usage.close()
        self._port.close()


def _key_of(entry: JailRecord) -> bytes:
    """Returns the key of a jail's client: ``Session.owner`` begins with it."""
    return entry.session[:KEY_BYTES]
