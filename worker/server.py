"""The worker server: ZeroMQ towards clients on one side, jails on the other.

Trusted code in one thread and one poll loop. It never decodes what a host says: it checks sizes
and order, and hands the frames on. A host that breaks the rules loses its jail.
"""

from __future__ import annotations

import itertools
import os
import secrets
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any

import zmq

from envhub_worker import __version__
from envhub_worker.channel import close_fds
from envhub_worker.deposits import Deposits
from envhub_worker.jailspec import JailSpec, confinement_from_wire
from envhub_worker.link import MAX_PENDING, HostLink
from envhub_worker.lockdown.scratch import remove_tree
from envhub_worker.output import OutputTail
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec import Buffer
from envhub_worker.protocol.confinement import Confinement
from envhub_worker.protocol.errors import ProtocolError
from envhub_worker.protocol.limits import DEFAULT_LIMITS, WireLimits
from envhub_worker.spawner import (
    Failed,
    HostExited,
    HostStarted,
    Jail,
    JailExited,
    Spawner,
    ZygoteDied,
)

MAX_HOSTS = 64
"""Hosts of one jail: one per useful core, not one per sub-environment."""
ATTACH = "attach"
"""The operation that brings a host its descriptors."""
MAX_JAILS = 256
"""Open jails of one server."""
_POLL_MS = 1000


@dataclass(frozen=True)
class Asker:
    """Who asked: the reply goes to this identity under this id."""

    identity: bytes
    request_id: int


@dataclass
class Opening:
    """An ``OpenJail`` or ``StartHosts`` whose hosts have not all come up."""

    asker: Asker
    waiting: set[int]
    hosts: tuple[int, ...]


@dataclass
class Pending:
    """A ``Relay`` that hosts still owe answers to."""

    asker: Asker
    operation: str
    replies: list[list[Buffer] | None]
    since: float = field(default_factory=monotonic)


@dataclass
class JailEntry:
    """A jail and everything that waits for it."""

    number: int
    name: str
    session: bytes
    jail: Jail
    spawner: tuple[object, ...]
    output: OutputTail
    links: dict[int, HostLink] = field(default_factory=dict)
    pids: dict[int, int] = field(default_factory=dict)
    report: tuple[object, ...] = ()
    opening: list[Opening] = field(default_factory=list)
    closing: list[Asker] = field(default_factory=list)
    death: m.Died | None = None
    released: bool = False

    def __post_init__(self) -> None:
        # kept, because closing a descriptor makes it forget its number
        self.control = self.jail.fileno()


class Server:
    """Serves until ``stop()``, or until the client's process ends."""

    def __init__(
        self,
        endpoint: str,
        runtime_dir: Path,
        readable_roots: Sequence[str],
        client_pidfd: int | None = None,
        limits: WireLimits = DEFAULT_LIMITS,
    ) -> None:
        self._runtime_dir = runtime_dir
        self._readable_roots = tuple(readable_roots)
        self._client_pidfd = client_pidfd
        self._limits = limits
        self._sessions: dict[bytes, bytes] = {}
        self._jails: dict[int, JailEntry] = {}
        self._spawners: dict[tuple[object, ...], Spawner] = {}
        self._packet_ids = itertools.count(1)
        self._stopped = False
        self._context = zmq.Context()
        self._router = self._listen(endpoint)
        self._poller = zmq.Poller()
        self._callbacks: dict[Any, Callable[[], None]] = {}
        self._watch(self._router, self._serve_clients)
        self._deposits = Deposits(str(runtime_dir / "fds"), self._pidfd_for)
        self._watch(self._deposits.fileno(), self._deposits.accept)
        if client_pidfd is not None:
            self._watch(client_pidfd, self.stop)

    def stop_on(self, *signals: int) -> None:
        """End the loop at these signals; to be called on the main thread."""
        woken, wakes = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        signal.set_wakeup_fd(wakes)
        for number in signals:
            signal.signal(number, lambda *_: self.stop())
        self._watch(woken, self.stop)

    def _listen(self, endpoint: str) -> zmq.Socket[bytes]:
        router = self._context.socket(zmq.ROUTER)
        router.setsockopt(zmq.LINGER, 0)
        router.setsockopt(zmq.MAXMSGSIZE, self._limits.frame_bytes)
        router.setsockopt(zmq.RCVHWM, 64)
        router.setsockopt(zmq.ROUTER_HANDOVER, 0)
        router.bind(endpoint)
        return router

    # --- the loop ------------------------------------------------------------------------------

    def run(self) -> None:
        """Serve; on the way out every jail and zygote is gone."""
        try:
            while not self._stopped:
                for ready, _ in self._poller.poll(_POLL_MS):
                    callback = self._callbacks.get(ready)
                    if callback is not None:
                        callback()
        finally:
            self._shut_down()

    def stop(self) -> None:
        """End the loop after the current round."""
        self._stopped = True

    def _watch(self, source: Any, callback: Callable[[], None], flags: int = zmq.POLLIN) -> None:
        self._poller.register(source, flags)
        self._callbacks[source] = callback

    def _unwatch(self, source: Any) -> None:
        if self._callbacks.pop(source, None) is not None:
            self._poller.unregister(source)

    def _shut_down(self) -> None:
        for entry in self._jails.values():
            self._kill(entry)
        for spawner in self._spawners.values():
            spawner.close()
        self._deposits.close()
        self._router.close()
        self._context.term()
        remove_tree(str(self._runtime_dir))  # its owner may not be there any more

    # --- clients -------------------------------------------------------------------------------

    def _serve_clients(self) -> None:
        while True:
            try:
                identity, *frames = self._router.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            self._serve(identity, frames)

    def _serve(self, identity: bytes, frames: list[bytes]) -> None:
        if not frames or len(frames[0]) > self._limits.header_bytes:
            return
        try:
            request_id, request = m.unpack(frames[:1], limits=self._limits)
        except ProtocolError:
            return  # not our protocol; there is no id to answer to
        asker = Asker(identity, request_id)
        try:
            self._dispatch(asker, request, frames[1:])
        except Exception as error:
            self._reply(asker, m.Refused("WorkerError", f"{type(error).__name__}: {error}", "", ""))

    def _dispatch(self, asker: Asker, request: m.Message, payload: list[bytes]) -> None:
        if isinstance(request, m.Hello):
            self._hello(asker, request)
        elif asker.identity not in self._sessions:
            self._refuse(asker, "LocalProtocolError", "say Hello first")
        elif isinstance(request, m.Relay):
            self._relay(asker, request, payload)
        else:
            handler = _HANDLERS.get(type(request))
            if handler is None:
                self._refuse(asker, "LocalProtocolError", f"{type(request).__name__} is no request")
            else:
                handler(self, asker, request)

    def _reply(self, asker: Asker, message: m.Message, payload: Sequence[Buffer] = ()) -> None:
        frames = [asker.identity, *m.pack(message, asker.request_id), *payload]
        self._router.send_multipart(frames, zmq.NOBLOCK, copy=False)

    def _refuse(
        self, asker: Asker, error: str, message: str, layer: str = "", fix: str = ""
    ) -> None:
        self._reply(asker, m.Refused(error, message, layer, fix))

    def _hello(self, asker: Asker, request: m.Hello) -> None:
        if not request.oldest <= m.VERSION <= request.newest:
            side = "client" if request.newest < m.VERSION else "worker"
            self._refuse(
                asker,
                "VersionMismatchError",
                f"the client speaks protocol {request.oldest} to {request.newest}, this worker "
                f"{m.VERSION}: upgrade the {side}",
            )
            return
        self._sessions[asker.identity] = request.session
        self._reply(asker, m.Welcome(m.VERSION, __version__, os.getpid()))

    def _owned(self, asker: Asker, number: int, operation: str = "") -> JailEntry | None:
        entry = self._jails.get(number)
        if entry is None or entry.session != self._sessions[asker.identity]:
            self._refuse(asker, "WorkerError", f"there is no jail {number}; it has been closed")
            return None
        if entry.death is not None:
            self._reply(asker, _for_operation(entry.death, operation))
            return None
        return entry

    # --- requests ------------------------------------------------------------------------------

    def _open_jail(self, asker: Asker, request: m.OpenJail) -> None:
        if len(self._jails) >= MAX_JAILS or not 1 <= request.hosts <= MAX_HOSTS:
            self._refuse(
                asker, "WorkerError", f"at most {MAX_JAILS} jails of 1 to {MAX_HOSTS} hosts"
            )
            return
        confinement = confinement_from_wire(request.confinement)
        spec = JailSpec(
            snapshot=request.snapshot,
            entry=request.entry,
            confinement=confinement,
            name=request.name,
        )
        key = (request.python, *(getattr(confinement, name) for name in _ZYGOTE_FIELDS))
        jail = self._spawner(key, confinement).spawn(spec)
        entry = JailEntry(
            number=secrets.randbits(62),
            name=request.name,
            session=self._sessions[asker.identity],
            jail=jail,
            spawner=key,
            output=OutputTail(jail.output, confinement.limits.output_bytes),
        )
        self._jails[entry.number] = entry
        self._watch(entry.control, lambda: self._jail_events(entry))
        self._watch(jail.output, lambda: self._read_output(entry))
        self._start_hosts(asker, entry, request.hosts)

    def _start_more(self, asker: Asker, request: m.StartHosts) -> None:
        entry = self._owned(asker, request.jail)
        if entry is None:
            return
        if not 1 <= request.hosts <= MAX_HOSTS - len(entry.links):
            self._refuse(asker, "WorkerError", f"a jail has at most {MAX_HOSTS} hosts")
            return
        self._start_hosts(asker, entry, request.hosts)

    def _start_hosts(self, asker: Asker, entry: JailEntry, count: int) -> None:
        hosts = tuple(self._start_host(entry) for _ in range(count))
        entry.opening.append(Opening(asker, set(hosts), hosts))

    def _start_host(self, entry: JailEntry) -> int:
        host, sock = entry.jail.start_host()
        link = entry.links[host] = HostLink(sock, self._limits)
        self._watch(link.fileno(), lambda: self._host_ready(entry, host))
        return host

    def _spawner(self, key: tuple[object, ...], confinement: Confinement) -> Spawner:
        spawner = self._spawners.get(key)
        if spawner is None:
            spawner = self._spawners[key] = Spawner(
                confinement,
                runtime_dir=self._runtime_dir,
                readable_roots=self._readable_roots,
                python=str(key[0]) or None,
            )
            self._watch(spawner.fileno(), lambda: self._spawner_events(key))
        return spawner

    def _relay(self, asker: Asker, request: m.Relay, payload: list[bytes]) -> None:
        entry = self._owned(asker, request.jail)
        if entry is None:
            return
        targets = self._relay_targets(entry, request, payload)
        if targets is None:
            self._refuse(asker, "LocalProtocolError", "the parts of Relay do not fit its frames")
            return
        if any(len(entry.links[host].pending) >= MAX_PENDING for host, _ in targets):
            self._refuse(asker, "WorkerError", f"a host owes {MAX_PENDING} answers already")
            return
        pending = Pending(asker, request.operation, [None] * len(targets))
        for index, (host, frames) in enumerate(targets):
            link = entry.links[host]
            fds = self._deposits.take(entry.number, host) if request.operation == ATTACH else []
            link.send(next(self._packet_ids), frames, (pending, index), fds)
            close_fds(fds)
            self._follow_writes(link)

    def _relay_targets(
        self, entry: JailEntry, request: m.Relay, payload: list[bytes]
    ) -> list[tuple[int, list[bytes]]] | None:
        targets = []
        start = 0
        for part in request.parts:
            if type(part) is not tuple or len(part) != 2 or part[0] not in entry.links:
                return None
            host, count = part
            if type(count) is not int or not 1 <= count <= len(payload) - start:
                return None
            targets.append((host, payload[start : start + count]))
            start += count
        return targets if targets and start == len(payload) else None

    def _pidfd_for(self, request: m.Deposit) -> int | None:
        entry = self._jails.get(request.jail)
        if entry is None or entry.session != request.session or entry.death is not None:
            return None
        return entry.jail.pidfd if request.host in entry.links and entry.jail.pidfd >= 0 else None

    def _follow_writes(self, link: HostLink) -> None:
        wanted = zmq.POLLIN | (zmq.POLLOUT if link.wants_write else 0)
        self._poller.register(link.fileno(), wanted)

    def _close_jail(self, asker: Asker, request: m.CloseJail) -> None:
        entry = self._jails.get(request.jail)
        if entry is None or entry.session != self._sessions[asker.identity]:
            self._reply(asker, m.Done())
        elif entry.released:
            del self._jails[entry.number]
            self._reply(asker, m.Done())
        else:  # also after its death: Done means that nothing of it is left
            entry.closing.append(asker)
            self._kill(entry)

    def _read_output_request(self, asker: Asker, request: m.ReadOutput) -> None:
        entry = self._owned(asker, request.jail, request.operation)
        if entry is not None:
            entry.output.read()
            self._reply(asker, m.Output(entry.output.text()))

    def _status(self, asker: Asker, request: m.GetStatus) -> None:
        session = self._sessions[asker.identity]
        mine = [entry for entry in self._jails.values() if entry.session == session]
        self._reply(asker, m.Status(tuple(_status_of(entry) for entry in mine)))

    # --- jails ---------------------------------------------------------------------------------

    def _host_ready(self, entry: JailEntry, host: int) -> None:
        link = entry.links[host]
        link.flush()
        try:
            answers = link.receive()
        except ProtocolError as error:
            self._end(entry, host, "protocol", detail=str(error))
            return
        if answers is None:
            self._unwatch(link.fileno())
            return  # its exit says more
        self._follow_writes(link)
        for packet, (pending, index) in answers:
            pending.replies[index] = packet.frames
            self._answer(pending)

    def _answer(self, pending: Pending) -> None:
        replies = [frames for frames in pending.replies if frames is not None]
        if len(replies) == len(pending.replies):
            payload = [frame for frames in replies for frame in frames]
            self._reply(pending.asker, m.Relayed(tuple(map(len, replies))), payload)

    def _read_output(self, entry: JailEntry) -> None:
        fd = entry.output.fileno()
        entry.output.read()
        if entry.output.fileno() < 0:
            self._unwatch(fd)

    def _jail_events(self, entry: JailEntry) -> None:
        for event in entry.jail.poll():
            if isinstance(event, HostStarted):
                self._host_started(entry, event)
            elif isinstance(event, Failed):
                self._failed(entry, event)
            elif isinstance(event, HostExited):
                self._host_exited(entry, event)

    def _host_started(self, entry: JailEntry, event: HostStarted) -> None:
        entry.pids[event.host_id] = event.pid
        entry.report = tuple(event.report)
        for opening in list(entry.opening):
            opening.waiting.discard(event.host_id)
            if not opening.waiting:
                entry.opening.remove(opening)
                opened = m.JailOpened(entry.number, opening.hosts, entry.report)
                self._reply(opening.asker, opened)

    def _failed(self, entry: JailEntry, event: Failed) -> None:
        for opening in entry.opening:
            self._refuse(
                opening.asker, "SandboxUnavailableError", event.reason, event.layer, event.fix
            )
        entry.opening.clear()
        self._end(entry, -1, "unavailable", detail=event.reason)

    def _host_exited(self, entry: JailEntry, event: HostExited) -> None:
        self._end(
            entry,
            event.host_id,
            event.reason,
            exit_code=event.code,
            signal=_signal_name(event.signal),
        )

    def _end(
        self,
        entry: JailEntry,
        host: int,
        reason: str,
        *,
        exit_code: int | None = None,
        signal: str | None = None,
        detail: str = "",
    ) -> None:
        """Write the jail's death down, tell everybody who waits, and make it true."""
        if entry.death is not None:
            return
        entry.output.read()
        death = m.Died(host, reason, exit_code, signal, detail, entry.output.text(), "")
        entry.death = death
        for pending in _waiting(entry):
            self._reply(pending.asker, _for_operation(death, pending.operation))
        for opening in entry.opening:
            self._reply(opening.asker, _for_operation(death, "start"))
        entry.opening.clear()
        self._kill(entry)

    def _kill(self, entry: JailEntry) -> None:
        self._deposits.drop(entry.number)
        self._unwatch(entry.control)
        entry.jail.kill()

    def _spawner_events(self, key: tuple[object, ...]) -> None:
        for event in self._spawners[key].poll():
            if isinstance(event, JailExited):
                self._jail_gone(event)
            elif isinstance(event, ZygoteDied):
                self._zygote_died(key, event)

    def _jail_gone(self, event: JailExited) -> None:
        entry = next((one for one in self._jails.values() if one.jail is event.jail), None)
        if entry is None:
            return
        if entry.closing:
            del self._jails[entry.number]
        else:
            self._jail_events(entry)  # its hosts' exits say more than its own
            self._end(entry, -1, "exit", exit_code=event.code, signal=_signal_name(event.signal))
        self._release(entry)
        for asker in entry.closing:
            self._reply(asker, m.Done())

    def _release(self, entry: JailEntry) -> None:
        entry.released = True
        for link in entry.links.values():
            self._unwatch(link.fileno())
            link.close()
        self._unwatch(entry.output.fileno())
        self._unwatch(entry.control)
        entry.output.close()
        for pending in _waiting(entry):
            death = m.Died(-1, "killed", None, None, "the jail was closed", "", pending.operation)
            self._reply(pending.asker, death)

    def _zygote_died(self, key: tuple[object, ...], event: ZygoteDied) -> None:
        spawner = self._spawners.pop(key)
        self._unwatch(spawner.fileno())
        for entry in list(self._jails.values()):
            if entry.spawner == key:
                self._end(entry, -1, "zygote", exit_code=event.code, detail=event.log)
                self._release(entry)
        spawner.close()


_ZYGOTE_FIELDS = ("profile", "network", "readable", "gpu")

_HANDLERS: dict[type[m.Message], Callable[[Server, Asker, Any], None]] = {
    m.OpenJail: Server._open_jail,
    m.StartHosts: Server._start_more,
    m.CloseJail: Server._close_jail,
    m.ReadOutput: Server._read_output_request,
    m.GetStatus: Server._status,
}


def _waiting(entry: JailEntry) -> list[Pending]:
    found = {}
    for link in entry.links.values():
        for pending, _ in link.pending.values():
            found[id(pending)] = pending
        link.pending.clear()
    return list(found.values())


def _for_operation(death: m.Died, operation: str) -> m.Died:
    return m.Died(
        death.host,
        death.reason,
        death.exit_code,
        death.signal,
        death.detail,
        death.tail,
        operation,
    )


def _signal_name(number: int | None) -> str | None:
    return None if number is None else signal.Signals(number).name


_STATES = {"R": "running", "S": "waiting", "D": "waiting", "T": "stopped", "t": "stopped"}


def _state_of(pid: int) -> str:
    """What the kernel says that a host is doing: of a busy environment nobody else can tell."""
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as file:
            # the command may hold anything, parentheses and blanks included
            return _STATES.get(file.read().rpartition(")")[2].split()[0], "gone")
    except (OSError, IndexError):
        return "gone"


def _status_of(entry: JailEntry) -> dict[str, object]:
    owed = [pending for link in entry.links.values() for pending, _ in link.pending.values()]
    oldest = min(owed, key=lambda pending: pending.since, default=None)
    return {
        "jail": entry.number,
        "name": entry.name,
        "pids": tuple(entry.pids.values()),
        "states": tuple(_state_of(pid) for pid in entry.pids.values()),
        "busy_s": 0.0 if oldest is None else monotonic() - oldest.since,
        "operation": "" if oldest is None else oldest.operation,
    }
