"""Handles clients' requests about jails: opens them, relays requests, reads output, closes them.

It also manages their zygotes, one for each runtime and each part of a policy that a zygote needs.
It starts a zygote when a jail needs one and ends idle zygotes if there are too many.

Trusted code. ``jail_events.py`` handles the events of jails.
"""

from __future__ import annotations

import itertools
import os
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from envhub_worker.lockdown.mechanisms.procfs import Children
from envhub_worker.lockdown.spec import JailSpec, confinement_from_wire
from envhub_worker.loop import Loop
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.confinement import Confinement
from envhub_worker.protocol.limits import DEFAULT_LIMITS, MAX_IN_FLIGHT, WireLimits, limits_for
from envhub_worker.protocol.runtime import Runtime
from envhub_worker.protocol.shared_memory import words
from envhub_worker.protocol.start_variables import at_start
from envhub_worker.spawn.channel import close_fds
from envhub_worker.spawn.spawner import JailExited, Spawner
from envhub_worker.spawn.zygote_process import ZygoteProcess
from envhub_worker.supervisor.fd_store import FdStore
from envhub_worker.supervisor.jail_events import JailEvents
from envhub_worker.supervisor.records import (
    AnsweredError,
    Asker,
    IdleTimer,
    JailRecord,
    Opening,
    OutputTail,
    Pending,
    RefusedError,
    Reply,
    Witness,
    status_of,
    whole_jail,
)
from envhub_worker.supervisor.runner_stream import RunnerLink
from envhub_worker.supervisor.served_slabs import ServedSlabs
from envhub_worker.supervisor.usage import CountLimit, reached, usage_of

MAX_RUNNERS, MAX_REMOTE_RUNNERS = 512, 64
"""Runners of one jail: up to one for each sub-environment; and where its client is on another host,
since each takes memory and descriptors of this server."""
MAX_JAILS = 256
"""Open jails of one server."""
MAX_SERVED_OUTPUT = 1 << 20
"""Bytes of what a jail prints that are kept for a client on another host."""
MAX_LOST = 4096
"""Most dead runners of a kept jail: each death is remembered."""
MAX_IDLE_ZYGOTES = 2
"""Most zygotes without jails that are kept when another is started. Most clients have one or two
policies."""
MAX_REMOTE_ZYGOTES = 16
"""Most zygotes of one client on another host: each is an interpreter that no jail's memory limit
counts. Clients on this host are its own user."""
_OF_POLICY = ("profile", "network", "readable", "gpu", "record_denials")

_Zygote = tuple[Any, ...]  # its name: a runtime, variables, and these parts of a policy


class Jails:
    """All jails of a server.
    ``fd_path``: the socket that receives descriptors; ``ahead``: a process for the first zygote.
    ``deaths``: number of jails, by reason, that have ended without a request.
    """

    def __init__(
        self,
        loop: Loop,
        reply: Reply,
        runtime_dir: Path,
        readable_roots: Sequence[str],
        fd_path: Path,
        ahead: ZygoteProcess | None,
        witness: Witness,
        *,
        local: bool,
    ) -> None:
        self._local = local  # whether all clients are this host's own user
        self._jails: dict[int, JailRecord] = {}
        self._packet_ids = itertools.count(1)  # of requests to runners, in all jails
        self._counting = CountLimit()  # bounds how often a client has processes counted
        self._fds = FdStore(str(fd_path), self._pidfd_for)
        loop.watch(self._fds.fileno(), self._fds.accept)
        self._events = JailEvents(loop, reply, self._jails, self._fds, witness)
        self.deaths: Mapping[str, int] = self._events.deaths
        self._loop = loop
        self._runtime_dir = runtime_dir
        self._readable_roots = readable_roots
        self._ahead = ahead  # taken by the first jail that needs a zygote
        # The one that was used longest ago is the first.
        self._spawners: dict[_Zygote, Spawner] = {}

    def close(self) -> None:
        """End every jail and zygote."""
        # All jails are told to end before any is waited for, so they end at the same time.
        for entry in self._jails.values():
            self._events.kill(entry)
        for spawner in self._spawners.values():
            spawner.close()
        if self._ahead is not None:
            self._ahead.discard()
        self._events.close()
        self._fds.close()

    # --- requests: each method returns the reply, or None if the reply comes later --------------

    def open(self, asker: Asker, request: m.OpenJail) -> None:
        """Fork a jail for a snapshot, and its first runners."""
        if len(self.open_ones()) >= MAX_JAILS:
            raise RefusedError("WorkerError", f"a server has at most {MAX_JAILS} jails")
        self._check_runners(request.runners, 0)
        copies = request.repositories
        confinement = confinement_from_wire(request.confinement)
        trees = tuple(copy.tree for copy in copies if copy.tree)
        confinement = replace(confinement, readable=(*confinement.readable, *trees))
        spec = JailSpec(
            snapshot=request.snapshot,
            entry=request.entry,
            confinement=confinement,
            hub_copies=copies,
        )
        # A zygote belongs to one runtime: jails with other packages never share its memory.
        started_with = frozenset(at_start(confinement.environment).items())
        of_policy = (getattr(confinement, name) for name in _OF_POLICY)
        zygote = (request.runtime, started_with, *of_policy)
        self._check_zygotes(asker, zygote)
        jail = self._spawner(zygote, request.runtime, confinement).spawn(spec)
        # Kept in the server's memory: as with the wire's limits, no stranger chooses how much.
        most = confinement.limits.output_bytes
        output_bytes = most if self._local else min(most, MAX_SERVED_OUTPUT)
        entry = JailRecord(
            number=secrets.randbits(62),
            name=request.name,
            session=asker.session,
            jail=jail,
            zygote=zygote,
            output=OutputTail(jail.output, output_bytes),
        )
        self._jails[entry.number] = entry
        self._events.follow(entry)
        self._start_runners(asker, entry, request.runners)

    def start_more(self, asker: Asker, request: m.StartRunners) -> None:
        """Fork further runners in an open jail."""
        entry = self._owned(asker, request.jail)
        self._check_runners(request.runners, len(entry.links))
        if len(entry.lost) > MAX_LOST:
            raise RefusedError("WorkerError", f"{len(entry.lost)} runners of this jail have died")
        self._start_runners(asker, entry, request.runners)

    def _check_zygotes(self, asker: Asker, zygote: _Zygote) -> None:
        held = {entry.zygote for entry in self.open_ones(asker.key)}
        if not self._local and zygote not in held and len(held) >= MAX_REMOTE_ZYGOTES:
            raise RefusedError(
                "WorkerError",
                f"your key has jails of {len(held)} kinds, which is the most. Jails of one kind "
                "have the same packages, policy, and variables that Python reads when it starts: "
                "close environments, or open new ones of a kind that is open already",
            )

    def _check_runners(self, more: int, present: int) -> None:
        most = MAX_RUNNERS if self._local else MAX_REMOTE_RUNNERS
        if not 1 <= more <= most - present:
            raise RefusedError(
                "WorkerError",
                f"{present + more} processes for the sub-environments of one environment: here it "
                f"may have 1 to {most}; set num_workers to at most {most}",
            )

    def _wire_limits(self, entry: JailRecord) -> WireLimits:
        """Returns the client's wire limits; for a client on another host at most our own."""
        most = entry.jail.spec.confinement.limits.message_bytes
        return limits_for(most if self._local else min(most, DEFAULT_LIMITS.message_bytes))

    def _start_runners(self, asker: Asker, entry: JailRecord, count: int) -> None:
        runners = []
        for _ in range(count):
            try:
                runner, sock = entry.jail.start_runner()
            except OSError as error:  # or those that did start would live on, unheard of
                self._events.end(entry, whole_jail("killed", detail=str(error)))
                raise
            entry.links[runner] = RunnerLink(sock, self._wire_limits(entry))
            self._events.follow_runner(entry, runner)
            runners.append(runner)
        entry.opening.append(Opening(asker, set(runners), tuple(runners)))

    def relay(self, asker: Asker, request: m.Relay, payload: list[bytes]) -> None:
        """Pass the payload to runners; the reply goes out once all of them have answered."""
        entry = self._owned(asker, request.jail)
        targets = _targets(entry, request, payload)
        if targets is None:
            raise RefusedError("LocalProtocolError", "the parts of Relay do not fit its frames")
        # Every target is checked before the first is sent anything. A request that is refused half
        # way would leave answers behind that nobody expects.
        for runner, frames in targets:
            link = entry.links.get(runner)
            if link is None:  # it has died, and its death is the answer
                continue
            if request.stepped and not _can_step(link, frames):
                raise RefusedError("LocalProtocolError", "a runner has no slabs, or owes a step")
            if link.unanswered >= MAX_IN_FLIGHT:
                raise RefusedError("WorkerError", f"a runner owes {MAX_IN_FLIGHT} answers already")
        pending = Pending(asker, request.operation, [None] * len(targets))
        for index, (runner, frames) in enumerate(targets):
            if runner in entry.lost:
                pending.lost(index, entry.lost[runner])
                continue
            link = entry.links[runner]
            if request.stepped:
                self._events.step(entry, link, frames[0], (pending, index))
                continue
            fds = self._fds.take(entry.number, runner) if request.deposited else []
            try:
                link.send(next(self._packet_ids), frames, (pending, index), fds)
                if entry.idle is not None and fds:
                    # The request and the reply slab.
                    entry.idle.watch(runner, [os.dup(fd) for fd in fds[:2]])
            finally:
                close_fds(fds)
            self._events.follow_writes(link)  # the socket may not have taken all of it
        if entry.idle is not None:
            entry.idle.begin()
        if pending.dead:
            self._events.gather(pending)

    def share(self, asker: Asker, request: m.ShareSlabs) -> m.Message:
        """Make slabs for runners; each gets its own with its ``Attach``."""
        entry = self._owned(asker, request.jail)
        most = self._wire_limits(entry).message_bytes
        room = entry.jail.spec.confinement.limits.memory_bytes
        pending: set[int] = set()
        for part in request.slabs:
            if type(part) is not tuple or list(map(type, part)) != [int] * 4:
                raise RefusedError("LocalProtocolError", "slabs are not four whole numbers")
            runner, leaves, request_bytes, observation_bytes = part
            if runner in entry.lost:
                continue  # the request that follows is answered with its death
            if runner not in entry.links or runner in pending:
                raise RefusedError("LocalProtocolError", f"no runner {runner}, or named twice")
            pending.add(runner)
            if entry.links[runner].unanswered:
                raise RefusedError("LocalProtocolError", f"runner {runner} owes an answer")
            if not words.served(leaves, request_bytes, observation_bytes, most):
                raise RefusedError("WorkerError", f"the sizes of slabs are out of range: {part}")
            # The kernel charges a page to the process that touches it first. For these slabs that
            # is the server, so the jail's own limits do not bound them.
            if entry.shared_bytes({runner}) + request_bytes + observation_bytes > room:
                raise RefusedError("WorkerError", "slabs would be larger than memory_bytes")
            slabs = ServedSlabs(leaves, request_bytes, observation_bytes)
            self._events.share(entry.links[runner], slabs)
            deposit, slabs.deposit = slabs.deposit, []
            self._fds.put(entry.number, runner, deposit)
        return m.Done()

    def keep(self, asker: Asker, request: m.KeepJail) -> m.Message:
        """Note whether a jail outlives its runners, and how long it lives without requests."""
        entry = self._owned(asker, request.jail)
        entry.kept = entry.kept or request.runners
        if request.idle_ms:
            entry.idle = entry.idle or IdleTimer(request.idle_ms / 1000)
        return m.Done()

    def look(self) -> None:
        """End the jails that were idle for longer than their limit. Called about once a second."""
        for entry in self.open_ones():
            busy = any(link.owed for link in entry.links.values())
            if entry.idle is not None and entry.idle.passed(busy):
                self.end(entry, f"it was idle for more than {entry.idle.limit_s:g} s")

    def _pidfd_for(self, request: m.Deposit) -> int | None:
        entry = self._found(request.session, request.jail)
        if entry is None or entry.death is not None or request.runner not in entry.links:
            return None
        # The pidfd may be -1: the zygote may report an init after that init has reported itself.
        return entry.jail.runner_pidfd(request.runner) if entry.kept else entry.jail.pidfd

    def _found(self, session: bytes, number: int) -> JailRecord | None:
        entry = self._jails.get(number)
        return entry if entry is not None and entry.session == session else None

    def _owned(self, asker: Asker, number: int, operation: str = "") -> JailRecord:
        """Returns the asker's live jail of this number. Raises the reply if there is none."""
        entry = self._found(asker.session, number)
        if entry is None:
            why = "the server was restarted, or the jail was closed, or given up by a task in it"
            raise RefusedError("WorkerDiedError", f"there is no jail {number}: {why}")
        if entry.death is not None:
            raise AnsweredError(m.replace(entry.death, operation=operation))
        return entry

    def close_jail(self, asker: Asker, request: m.CloseJail) -> m.Message | None:
        """End a jail, also after its death: ``Done`` means that all its processes have ended."""
        entry = self._found(asker.session, request.jail)
        if entry is not None and not entry.released:
            entry.closing.append(asker)
            self._events.kill(entry)
            return None
        if entry is not None:
            del self._jails[entry.number]
        return m.Done()

    def check(self, asker: Asker, request: m.CheckJail) -> m.Message:
        """Say whether a jail lives."""
        entry = self._owned(asker, request.jail, request.operation)
        if entry.idle is not None:
            entry.idle.begin()  # so that the request that follows finds it alive
        return m.Done()

    def follow_output(self, asker: Asker, request: m.FollowOutput) -> m.Message:
        """Returns output after an offset, also of a dead jail."""
        entry = self._found(asker.session, request.jail)
        if entry is None:
            raise RefusedError("WorkerError", f"there is no jail {request.jail}")
        entry.output.read()
        return m.OutputBytes(*entry.output.since(request.offset))

    def status(self, asker: Asker, request: m.GetStatus) -> m.Message:
        """Returns the state and the resources of the asker's jails."""
        mine = [entry for entry in self._jails.values() if entry.session == asker.session]
        for entry in mine:
            self._events.catch_up(entry)  # it said so before it answered the client that asks now
        children = self._counting.children() if mine else None
        return m.Status(tuple({**status_of(record), **_held(record, children)} for record in mine))

    # --- zygotes -------------------------------------------------------------------------------

    def _spawner(self, zygote: _Zygote, runtime: Runtime, confinement: Confinement) -> Spawner:
        spawner = self._spawners.pop(zygote, None)
        if spawner is None:
            self._end_idle()
            ahead, self._ahead = self._ahead, None
            spawner = Spawner(
                confinement,
                runtime_dir=self._runtime_dir,
                readable_roots=self._readable_roots,
                runtime=runtime,
                ahead=ahead,
            )
            self._loop.watch(spawner.fileno(), partial(self._poll, zygote))
        self._spawners[zygote] = spawner  # the one that was used last is the last
        return spawner

    def _end_idle(self) -> None:
        """End idle zygotes over the limit: otherwise ever new policies would fill the memory."""
        used = {entry.zygote for entry in self._jails.values() if not entry.released}
        idle = [zygote for zygote in self._spawners if zygote not in used]
        for zygote in idle[: max(0, len(idle) - MAX_IDLE_ZYGOTES)]:
            spawner = self._spawners.pop(zygote)
            self._loop.unwatch(spawner.fileno())
            spawner.close()

    def _poll(self, zygote: _Zygote) -> None:
        for event in self._spawners[zygote].poll():
            if isinstance(event, JailExited):
                self._events.jail_gone(event)
            else:
                spawner = self._spawners.pop(zygote)
                self._loop.unwatch(spawner.fileno())
                self._events.zygote_died(zygote, event)
                spawner.close()

    # --- for the gate --------------------------------------------------------------------------

    def open_ones(self, owner: bytes = b"") -> list[JailRecord]:
        """Returns the live jails of sessions whose owner begins with a prefix."""
        return [
            entry
            for entry in self._jails.values()
            if entry.death is None and not entry.closing and entry.session.startswith(owner)
        ]

    @property
    def packages(self) -> frozenset[str]:
        """Returns the folders of packages that jails and idle zygotes have mounted."""
        return frozenset(runtime.packages for runtime, *_ in self._spawners)

    def statuses(self, owner: bytes) -> list[dict[str, object]]:
        """Returns the states of a session's jails."""
        return [status_of(entry) for entry in self.open_ones(owner)]

    def end(self, entry: JailRecord, why: str) -> None:
        """End a jail that no client closes. A client that comes back reads the reason."""
        self._events.end(entry, whole_jail("idle", detail=why))


def _held(entry: JailRecord, children: Children | None) -> dict[str, object]:
    usage: dict[str, int] = {}
    if entry.death is None and children is not None:
        usage = usage_of(entry.jail.pid, entry.pids.values(), children)
    if not entry.jail.spec.confinement.record_denials:
        return {**usage}
    if entry.death is None:
        _note_limits(entry, usage)
    return {**usage, "denied": tuple(entry.denied)}


def _note_limits(entry: JailRecord, usage: dict[str, int]) -> None:
    """Put exhausted limits in front of the denials, where a flood of others cannot hide them."""
    confinement = entry.jail.spec.confinement
    runners, own_root = entry.jail.runner_pids(), confinement.profile == "strict"
    limits = set(reached(confinement.limits, usage, runners, own_root=own_root))
    if entry.jail.refused_processes():
        limits.add("PROCESSES")
    for name in sorted(limits):
        if f"limit {name}" not in entry.denied:
            entry.denied.insert(0, f"limit {name}")


def _can_step(link: RunnerLink, frames: list[bytes]) -> bool:
    slabs = link.slabs
    return slabs is not None and slabs.owner is None and len(frames) == 1 and slabs.fits(frames[0])


def _targets(
    entry: JailRecord, request: m.Relay, payload: list[bytes]
) -> list[tuple[int, list[bytes]]] | None:
    """Returns the frames of each runner; None if parts, runners and frames do not match."""
    targets: dict[int, list[bytes]] = {}
    start = 0
    for part in request.parts:
        if type(part) is not tuple or list(map(type, part)) != [int, int]:
            return None
        runner, count = part
        is_known = runner in entry.links or runner in entry.lost
        if runner in targets or not is_known or not 1 <= count <= len(payload) - start:
            return None
        targets[runner] = payload[start : start + count]
        start += count
    return list(targets.items()) if targets and start == len(payload) else None
