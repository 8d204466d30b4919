"""What a server's clients may do: everything, or what a stranger's quotas permit.

One ``Server`` serves both. A ``LocalGate`` stands before a socket in a private folder, whose
clients are the user who started the server. A ``RemoteGate`` stands before a TCP port: its clients
have proved a key, and still may neither name a path of this machine nor take it all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import zmq

from envhub_worker.access.connection_limit import MAX_CONNECTIONS, Doorman
from envhub_worker.access.drain import Drain
from envhub_worker.access.events import Events
from envhub_worker.access.figures import Clients, Facts, Tally, client_name
from envhub_worker.access.keys import AuthorizedClients, KeyPair
from envhub_worker.access.line import RETRY_S, Line
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
from envhub_worker.access.rate_limited_log import Log
from envhub_worker.access.sessions import WATCHER, Session, Sessions
from envhub_worker.access.uploads import PREFIX, Uploads, wrong_with_path
from envhub_worker.access.usage import Usage
from envhub_worker.access.zap import DOMAIN, Zap
from envhub_worker.lockdown.spec import confinement_from_wire
from envhub_worker.loop import Loop
from envhub_worker.multipart import receive
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.busy import Busy
from envhub_worker.protocol.errors import ProtocolError
from envhub_worker.protocol.keys import KEY_BYTES, key_text
from envhub_worker.protocol.records import dataclass
from envhub_worker.supervisor.jails import Jails
from envhub_worker.supervisor.records import Asker, JailEntry
from envhub_worker.supervisor.witness import Nobody, Witness

_HANDSHAKE_MS = 5_000
_HEARTBEAT_MS = 15_000
_HEARTBEAT_TIMEOUT_MS = 60_000
_BACKLOG = 64
_SNDHWM = 32
_FORGOTTEN_S = 3600.0
"""Where silent clients keep their jails, those without any are forgotten after so long."""
_PLACE_NEEDED = "its client has gone, and its key needed the place"
ANYBODY = bytes(KEY_BYTES)
"""The key of clients that have none, behind ``--insecure-loopback``."""


class Asked(NamedTuple):
    """A request, who asks, and what it is asked of."""

    asker: Asker
    request: m.Message
    payload: Sequence[bytes]
    sessions: Sessions
    jails: Jails


class Arrived(NamedTuple):
    """A message as it came.

    Attributes:
        identity: The routing id of its sender.
        key: The key that he has proved; empty where none is needed.
        frames: The message.
        fd: The descriptor of the connection that it came over; -1 if that is not known.
    """

    identity: bytes
    key: bytes
    frames: list[Any]
    fd: int = -1


class Greeting(NamedTuple):
    """A ``Hello``: whose it is, and the name of the session that it asks for."""

    arrived: Arrived
    name: bytes
    sessions: Sessions
    jails: Jails


Handler = Callable[[Asked], m.Message]
"""Carries a request out that is permitted; returns the reply."""


class Gate(Protocol):
    """Decides what a client may.

    Attributes:
        handlers: The requests that only this gate knows.
        compresses: Whether frames are worth compressing.
        idle_s: How long the jails of a client that says nothing live on; 0 for ever.
        witness: Is told what becomes of jails.
    """

    handlers: Mapping[type[m.Message], Handler]
    compresses: bool
    idle_s: int
    witness: Witness

    def secure(self, router: zmq.Socket[bytes], loop: Loop) -> None:
        """Set what must be set before the socket is bound."""

    def receive(self, router: zmq.Socket[bytes]) -> Arrived:
        """A message that is there."""

    def greet(self, greeting: Greeting) -> None:
        """A session begins, or is found again; raises ``RefusedError``."""

    def authorize(self, asked: Asked) -> m.Message:
        """The request as it may be carried out, never a reply; raises ``RefusedError``."""

    def answered(self, asker: Asker) -> None:
        """A request was answered."""

    def refused(self, asker: Asker, error: str, message: str, layer: str, fix: str) -> None:
        """A request was answered so."""

    def tick(self, sessions: Sessions, jails: Jails) -> None:
        """Time has passed."""

    def drain(self) -> bool:
        """Let nothing new in from now on; False if nothing that runs is waited for."""

    def drained(self, jails: Jails) -> bool:
        """Whether that has been said, and nothing runs any more."""

    def close(self) -> None:
        """Close what ``secure`` opened."""


class LocalGate:
    """The folder of the socket is the gate: whoever can reach it is the user."""

    handlers: Mapping[type[m.Message], Handler] = MappingProxyType({})
    compresses = False
    idle_s = 0
    witness: Witness = Nobody()

    def secure(self, router: zmq.Socket[bytes], loop: Loop) -> None:
        """Nothing: the folder is of mode 0700."""

    def receive(self, router: zmq.Socket[bytes]) -> Arrived:
        """Nobody has a key."""
        identity, *frames = receive(router)
        return Arrived(identity, b"", frames)

    def greet(self, greeting: Greeting) -> None:
        """Everybody is welcome."""
        arrived = greeting.arrived
        greeting.sessions.connect(arrived.identity, arrived.key, greeting.name)

    def authorize(self, asked: Asked) -> m.Message:
        """Everything is permitted."""
        return asked.request

    def answered(self, asker: Asker) -> None:
        """Nothing is counted."""

    def refused(self, asker: Asker, error: str, message: str, layer: str, fix: str) -> None:
        """Its client says so."""

    def tick(self, sessions: Sessions, jails: Jails) -> None:
        """The server ends with its client."""

    def drain(self) -> bool:
        """There is one client, and it would wait for itself."""
        return False

    def drained(self, jails: Jails) -> bool:
        """Never."""
        return False

    def close(self) -> None:
        """There is nothing to close."""


@dataclass(frozen=True, kw_only=True)
class Rules:
    """How a ``RemoteGate`` is set up.

    Attributes:
        keys: The server's key pair; None only for ``--insecure-loopback``.
        authorized: Whose keys may come in.
        operators: Keys that see everybody's sessions: the server's own.
        quotas: What one key may take.
        permissions: What a policy may ask for.
        idle_s: How long the jails of a client that says nothing live on.
        max_connections: Of everybody together, strangers included.
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
        log: Log,
        publish: Callable[[Mapping[str, Any]], None] | None = None,
    ) -> None:
        self.idle_s = rules.idle_s
        self._rules = rules
        self._uploads = uploads
        self._log = log
        self._events = Events(log, self._name_of)
        self.witness: Witness = self._events
        self._in_flight = InFlight()
        self._lines = {"sessions": Line(), "jails": Line()}
        self._drain = Drain(rules.drain_s)
        self._publish = publish
        self._tally, self._usage = Tally(), Usage()
        self._facts = Facts(
            profile=rules.profile,
            permissions=rules.permissions,
            quotas=rules.quotas,
            state=str(uploads.folder),
            max_connections=rules.max_connections,
        )
        self._closers: list[Callable[[], None]] = []
        self._doorman: Doorman | None = None
        self.handlers: Mapping[type[m.Message], Handler] = {
            m.OfferSnapshot: self._offer,
            m.PutBlob: self._put,
            m.KeepAlive: self._keep,
            m.GetSessions: self._tell_sessions,
        }

    # --- the socket ----------------------------------------------------------------------------

    def secure(self, router: zmq.Socket[bytes], loop: Loop) -> None:
        """CURVE, and what bounds a peer that keeps none of the rules."""
        router.setsockopt(zmq.HANDSHAKE_IVL, _HANDSHAKE_MS)
        router.setsockopt(zmq.HEARTBEAT_IVL, _HEARTBEAT_MS)
        router.setsockopt(zmq.HEARTBEAT_TIMEOUT, _HEARTBEAT_TIMEOUT_MS)
        router.setsockopt(zmq.BACKLOG, _BACKLOG)
        router.setsockopt(zmq.SNDHWM, _SNDHWM)
        self._doorman = Doorman(router, loop, self._log, self._rules.max_connections)
        self._closers.append(self._doorman.close)
        keys = self._rules.keys
        if keys is None:
            return
        zap = Zap(router.context, self._admits)
        self._closers.append(zap.close)
        loop.watch(zap.socket, zap.answer)
        router.setsockopt(zmq.CURVE_SERVER, 1)
        router.setsockopt(zmq.CURVE_SECRETKEY, keys.secret)
        router.setsockopt(zmq.ZAP_DOMAIN, DOMAIN)
        # without it libzmq lets everybody in whom no handler was there to ask about
        router.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)

    def _admits(self, key: bytes, address: str) -> bool:
        if self._rules.authorized.name_of(key) is not None or key in self._rules.operators:
            return True
        # a kind of its own: noise at the port must not count away the line that an operator needs
        self._log.say("unknown_key", key=key_text(key), address=address)
        return False

    def receive(self, router: zmq.Socket[bytes]) -> Arrived:
        """The key is the one that was proved in the handshake, never what the peer claims."""
        identity = router.recv(zmq.NOBLOCK)
        # not of the frame before: libzmq 4.3.4 knows nothing of who sent the first one
        header = router.recv(zmq.NOBLOCK, copy=False)
        rest = receive(router) if header.more else []
        frames = [header.bytes, *rest]
        return Arrived(identity, self._key_of(header), frames, _descriptor_of(header))

    def _key_of(self, frame: zmq.Frame) -> bytes:
        if self._rules.keys is None:
            return ANYBODY
        try:
            return bytes.fromhex(str(frame.get("User-Id")))
        except (zmq.ZMQError, ValueError):
            return b""

    # --- requests ------------------------------------------------------------------------------

    def greet(self, greeting: Greeting) -> None:
        """Refuse who has proved no key, and more sessions than the quota."""
        (identity, key, _, fd), name, sessions, jails = greeting
        self._refuse_unless_authorized(key)
        if len(name) > 64:
            raise RefusedError("LocalProtocolError", "the name of a session is too long")
        self._end_deserted(sessions, jails)
        if name != WATCHER and name not in {one.name for one in sessions.of_key(key)}:
            self._drain.refuse_new()
        others = [one for one in sessions.of_key(key) if one.name not in (name, WATCHER)]
        quota = self._rules.quotas.sessions
        if name != WATCHER and len(others) >= quota:
            gone = _longest_gone(others)
            if gone is None:
                self._lines["sessions"].wait(key, name)
                raise BusyError(
                    Busy("sessions", len(others), quota, RETRY_S),
                    f"your key has {quota} sessions, which is the server's quota (--max-sessions)",
                )
            self._end(gone, sessions, jails, _PLACE_NEEDED)
        elif name not in {one.name for one in sessions.of_key(key)}:
            self._refuse_behind("sessions", key, name, len(others), quota)
        self._lines["sessions"].leave(key, name)
        wire = 0 if self._doorman is None else self._doorman.wire(fd)
        known = {one.name for one in sessions.of_key(key)}
        session = sessions.connect(identity, key, name, wire)
        if name not in known:
            self._events.came(session)

    def authorize(self, asked: Asked) -> m.Message:
        """Hold a request against keys and quotas."""
        asker, request = asked.asker, asked.request
        self._refuse_unless_authorized(asker.key)
        if isinstance(request, (m.OpenJail, m.OfferSnapshot)):
            self._drain.refuse_new()
        if isinstance(request, m.OpenJail):
            return self._authorize_open(asked, request)
        if isinstance(request, m.StartRunners):
            self._find_place(asked, Use(0, request.runners))
        elif isinstance(request, m.Relay):
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
                self._disconnect(sessions)
                # its own may look so, too: what it said last is read after it has gone
                others = [one for one in sessions.of_key(asker.key) if one.owner != asker.session]
                gone = _longest_gone(others)
                if gone is None:
                    if more.memory_bytes:
                        self._lines["jails"].wait(asker.key, asker.session)
                    raise
                self._end(gone, sessions, jails, _PLACE_NEEDED)
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
        self._find_place(asked, Use(confinement.limits.memory_bytes, request.runners))
        tree = self._uploads.tree(asked.asker.key, request.snapshot)
        self._tally.open(self._label_of(asked.asker.key))
        return m.OpenJail(
            request.name[:512], "", tree, request.entry, request.confinement, request.runners
        )

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
        if asker.version >= m.FIRST_WITH_FIGURES_VERSION:
            told.append({"server": self.figures(asked.sessions, asked.jails, asker.key)})
        return m.Sessions(tuple(told))

    def answered(self, asker: Asker) -> None:
        """Its bytes are no longer in flight."""
        self._in_flight.answered(asker)

    def refused(self, asker: Asker, error: str, message: str, layer: str, fix: str) -> None:
        """The operator is told, and it is counted."""
        self._tally.refused(error, layer)
        self._events.refused(asker, error, message, layer, fix)

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
        return {
            **told,
            **self._facts.for_operators(),
            "connections": 0 if self._doorman is None else len(self._doorman.open_wires()),
            "waiting": {quota: line.waiting for quota, line in self._lines.items()},
            "refusals": dict(self._tally.refusals),
            "deaths": dict(jails.deaths),
            "clients": clients.told(),
        }

    def _sessions_of(self, key: bytes, sessions: Sessions, jails: Jails) -> list[dict[str, Any]]:
        rules = self._rules
        self._end_deserted(sessions, jails)
        seen = sessions.all() if key in rules.operators else sessions.of_key(key)
        used = {key: self._uploads.used_bytes(key) for key in {one.key for one in seen}}
        return [
            {
                "client": self._name_of(one.key) or "operator",
                "key": key_text(one.key),
                "session": one.name.hex()[:8],
                "protocol": one.version,
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
        if self._doorman is not None:
            self._doorman.tick()
        try:
            self._rules.authorized.refresh()
        except (OSError, ValueError) as error:
            self._log.say("clients_kept_as_they_were", why=str(error))
        for session in sessions.all():
            if not self._is_known(session.key):
                self._end(session, sessions, jails, "its key is not authorised any more")
        self._end_deserted(sessions, jails)
        for session in sessions.idle(self.idle_s or _FORGOTTEN_S):
            if self.idle_s:
                why = f"nothing was heard of its client for {self.idle_s} s"
                self._end(session, sessions, jails, why)
            elif not jails.open_ones(session.owner):
                self._drop(session, sessions, "nothing was heard of it for long")
        if self.idle_s:
            self._end_unheld(sessions, jails)
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

    def drain(self) -> bool:
        """Refuse new sessions and jails; those that run have ``drain_s``."""
        return self._drain.begin(self._log)

    def drained(self, jails: Jails) -> bool:
        """Whether it may end: no jail is left, and everybody had a moment to hear so."""
        return self._drain.begun and self._drain.quiet(bool(jails.open_ones()))

    def _end_deserted(self, sessions: Sessions, jails: Jails) -> None:
        """Forget the connections that have gone, and the sessions that have nothing else.

        A client that is only cut off loses nothing: what it had was a name. One that has jails
        keeps them, for ``idle_s``, or until others of its key need the place.
        """
        self._disconnect(sessions)
        for session in sessions.all():
            if not session.connections and not jails.open_ones(session.owner):
                self._drop(session, sessions, "its connections have ended")

    def _disconnect(self, sessions: Sessions) -> None:
        if self._doorman is not None:
            sessions.disconnect(self._doorman.open_wires())

    def _end_unheld(self, sessions: Sessions, jails: Jails) -> None:
        for session in sessions.all():
            for entry in jails.open_ones(session.owner):
                if sessions.unheld(session, entry.number, self.idle_s):
                    jails.end(entry, "its client gave it up")

    def _end(self, session: Session, sessions: Sessions, jails: Jails, why: str) -> None:
        for entry in jails.open_ones(session.owner):
            jails.end(entry, why)
        self._drop(session, sessions, why)

    def _drop(self, session: Session, sessions: Sessions, why: str) -> None:
        self._uploads.forget(session.owner)
        sessions.drop(session)
        self._events.left(session, why)

    def close(self) -> None:
        """Close the sockets of the handshakes."""
        self._usage.close()
        for close in self._closers:
            close()


def _longest_gone(sessions: Sequence[Session]) -> Session | None:
    """The session without a connection that was heard from the longest ago, if there is one."""
    gone = [one for one in sessions if not one.connections]
    return min(gone, key=lambda one: one.heard, default=None)


def _descriptor_of(frame: zmq.Frame) -> int:
    try:
        return int(frame.get(zmq.SRCFD))
    except (zmq.ZMQError, ValueError):
        return -1


def _key_of(entry: JailEntry) -> bytes:
    """Whose a jail is: what it is marked with begins with the key, see ``Session.owner``."""
    return entry.session[:KEY_BYTES]


def _uses(jails: Jails, key: bytes) -> list[Use]:
    return [
        Use(entry.jail.spec.confinement.limits.memory_bytes, len(entry.links))
        for entry in jails.open_ones(key)
    ]
