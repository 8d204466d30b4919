"""The jails of a worker server: opened, asked, watched, and ended.

Trusted code. It never decodes what a runner says: it checks sizes and order, and hands the frames
on. A runner that breaks the rules loses its jail.
"""

from __future__ import annotations

import itertools
import os
import secrets
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

from envhub_worker.channel import close_fds
from envhub_worker.lockdown.spec import JailSpec, confinement_from_wire
from envhub_worker.loop import Loop
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.confinement import Confinement
from envhub_worker.protocol.errors import ProtocolError
from envhub_worker.protocol.limits import WireLimits
from envhub_worker.protocol.runtime import Runtime
from envhub_worker.spawn.jail_handle import (
    Failed,
    JailExited,
    RunnerExited,
    RunnerStarted,
    Spawner,
    ZygoteDied,
)
from envhub_worker.spawn.zygote_process import ZygoteProcess
from envhub_worker.supervisor.fd_store import Deposits
from envhub_worker.supervisor.idle_timer import Idleness
from envhub_worker.supervisor.output_tail import OutputTail
from envhub_worker.supervisor.records import (
    Answers,
    Asker,
    JailEntry,
    Opening,
    Pending,
    for_operation,
    owes,
    signal_name,
    status_of,
    waiting,
)
from envhub_worker.supervisor.runner_stream import MAX_PENDING, RunnerLink

MAX_RUNNERS = 64
"""Runners of one jail: one per useful core, not one per sub-environment."""
MAX_IDLE_ZYGOTES = 2
"""Without a jail, when another is started. A client mostly has one policy, or two in turns."""
MAX_JAILS = 256
"""Open jails of one server."""
MAX_DEAD = 256
"""Jails that have ended and are not closed, whose deaths are remembered."""
MAX_LOST = 4096
"""Runners of a kept jail that may die: their deaths are remembered."""


class Jails:
    """All jails of a server, and the zygotes that fork them.

    Args:
        loop: Calls back when one of their descriptors is ready.
        answers: Takes the replies.
        runtime_dir: An existing folder of the server's own.
        readable_roots: Where snapshots lie.
        limits: Bounds on what a runner may say.
        fd_path: The socket that takes descriptors.
        ahead: A process for the first zygote.
    """

    def __init__(
        self,
        loop: Loop,
        answers: Answers,
        runtime_dir: Path,
        readable_roots: Sequence[str],
        limits: WireLimits,
        fd_path: Path,
        ahead: ZygoteProcess | None = None,
    ) -> None:
        self._ahead = ahead
        self._loop = loop
        self._answers = answers
        self._runtime_dir = runtime_dir
        self._readable_roots = tuple(readable_roots)
        self._limits = limits
        self._jails: dict[int, JailEntry] = {}
        self._spawners: dict[tuple[object, ...], Spawner] = {}
        self._packet_ids = itertools.count(1)
        self._deposits = Deposits(str(fd_path), self._pidfd_for)
        loop.watch(self._deposits.fileno(), self._deposits.accept)

    def close(self) -> None:
        """End every jail and zygote."""
        for entry in self._jails.values():
            self._kill(entry)
        for spawner in self._spawners.values():
            spawner.close()
        if self._ahead is not None:
            self._ahead.discard()
        self._deposits.close()

    # --- requests ------------------------------------------------------------------------------

    def open(self, asker: Asker, request: m.OpenJail) -> None:
        """Fork a jail for a snapshot, and its first runners."""
        if len(self.open_ones()) >= MAX_JAILS or not 1 <= request.runners <= MAX_RUNNERS:
            self._answers.refuse(
                asker, "WorkerError", f"at most {MAX_JAILS} jails of 1 to {MAX_RUNNERS} runners"
            )
            return
        confinement = confinement_from_wire(request.confinement)
        spec = JailSpec(
            snapshot=request.snapshot,
            entry=request.entry,
            confinement=confinement,
            name=request.name,
        )
        # a zygote is one environment's: not even what it has not imported is shared with another
        key = (request.runtime, *(getattr(confinement, name) for name in _ZYGOTE_FIELDS))
        jail = self._spawner(key, request.runtime, confinement).spawn(spec)
        entry = JailEntry(
            number=secrets.randbits(62),
            name=request.name,
            session=asker.session,
            jail=jail,
            spawner=key,
            output=OutputTail(jail.output, confinement.limits.output_bytes),
        )
        self._jails[entry.number] = entry
        self._watch(entry, entry.control, lambda: self._jail_events(entry))
        self._watch(entry, jail.output, lambda: self._read_output(entry))
        self._start_runners(asker, entry, request.runners)

    def start_more(self, asker: Asker, request: m.StartRunners) -> None:
        """Fork further runners in an open jail."""
        entry = self._owned(asker, request.jail)
        if entry is None:
            return
        if not 1 <= request.runners <= MAX_RUNNERS - len(entry.links):
            self._answers.refuse(asker, "WorkerError", f"a jail has at most {MAX_RUNNERS} runners")
            return
        if len(entry.lost) > MAX_LOST:
            self._answers.refuse(
                asker, "WorkerError", f"{len(entry.lost)} of its runners have died"
            )
            return
        self._start_runners(asker, entry, request.runners)

    def _start_runners(self, asker: Asker, entry: JailEntry, count: int) -> None:
        runners = tuple(self._start_runner(entry) for _ in range(count))
        entry.opening.append(Opening(asker, set(runners), runners))

    def _start_runner(self, entry: JailEntry) -> int:
        runner, sock = entry.jail.start_runner()
        link = entry.links[runner] = RunnerLink(sock, self._limits)
        self._watch(entry, link.fileno(), lambda: self._runner_ready(entry, runner))
        return runner

    def _watch(self, entry: JailEntry, fd: int, callback: Callable[[], None]) -> None:
        """Whatever goes wrong with a jail is its own end, and not the server's."""

        def guarded() -> None:
            try:
                callback()
            except Exception as error:
                traceback.print_exc()
                what = f"an error of the worker server: {type(error).__name__}: {error}"
                self._end(entry, m.Died(-1, "killed", None, None, what, "", ""))

        self._loop.watch(fd, guarded)

    def _spawner(
        self, key: tuple[object, ...], runtime: Runtime, confinement: Confinement
    ) -> Spawner:
        spawner = self._spawners.pop(key, None)
        if spawner is None:
            self._end_idle_zygotes()
            ahead, self._ahead = self._ahead, None
            spawner = Spawner(
                confinement,
                runtime_dir=self._runtime_dir,
                readable_roots=self._readable_roots,
                runtime=runtime,
                ahead=ahead,
            )
            self._loop.watch(spawner.fileno(), lambda: self._spawner_events(key))
        self._spawners[key] = spawner  # the one that was used last is the last
        return spawner

    def _end_idle_zygotes(self) -> None:
        """A client with ever new policies does not fill the machine with warm interpreters."""
        used = {entry.spawner for entry in self._jails.values() if not entry.released}
        idle = [key for key in self._spawners if key not in used]
        for key in idle[: max(0, len(idle) - MAX_IDLE_ZYGOTES)]:
            spawner = self._spawners.pop(key)
            self._loop.unwatch(spawner.fileno())
            spawner.close()

    def relay(self, asker: Asker, request: m.Relay, payload: list[bytes]) -> None:
        """Hand the payload to runners; the reply goes out once all of them have answered."""
        entry = self._owned(asker, request.jail)
        if entry is None:
            return
        targets = self._relay_targets(entry, request, payload)
        if targets is None:
            self._answers.refuse(
                asker, "LocalProtocolError", "the parts of Relay do not fit its frames"
            )
            return
        if any(owes(entry, runner) >= MAX_PENDING for runner, _ in targets):
            self._answers.refuse(
                asker, "WorkerError", f"a runner owes {MAX_PENDING} answers already"
            )
            return
        pending = Pending(asker, request.operation, [None] * len(targets))
        for index, (runner, frames) in enumerate(targets):
            if runner in entry.lost:
                pending.lost(index, entry.lost[runner])
                continue
            link = entry.links[runner]
            fds = self._deposits.take(entry.number, runner)
            try:
                link.send(next(self._packet_ids), frames, (pending, index), fds)
                if entry.idle is not None and fds:
                    entry.idle.watch(runner, [os.dup(fd) for fd in fds[:2]])
            finally:
                close_fds(fds)
            self._follow_writes(link)
        if entry.idle is not None:
            entry.idle.begin()
        if pending.dead:
            self._gather(pending)

    def _relay_targets(
        self, entry: JailEntry, request: m.Relay, payload: list[bytes]
    ) -> list[tuple[int, list[bytes]]] | None:
        targets: list[tuple[int, list[bytes]]] = []
        asked: set[int] = set()
        start = 0
        for part in request.parts:
            if type(part) is not tuple or len(part) != 2:
                return None
            runner, count = part
            if type(runner) is not int or runner in asked:
                return None
            asked.add(runner)
            if runner not in entry.links and runner not in entry.lost:
                return None
            if type(count) is not int or not 1 <= count <= len(payload) - start:
                return None
            targets.append((runner, payload[start : start + count]))
            start += count
        return targets if targets and start == len(payload) else None

    def keep(self, asker: Asker, request: m.KeepJail) -> None:
        """From now on the death of a runner is its own affair."""
        entry = self._owned(asker, request.jail)
        if entry is not None:
            entry.kept = True
            self._answers.reply(asker, m.Done())

    def expire(self, asker: Asker, request: m.ExpireIdle) -> None:
        """End it once it has done nothing for so long."""
        entry = self._owned(asker, request.jail)
        if entry is not None:
            if entry.idle is None:
                entry.idle = Idleness(request.idle_ms / 1000)
            self._answers.reply(asker, m.Done())

    def look(self) -> None:
        """End the jails that have done nothing for longer than they may; about once a second."""
        for entry in self.open_ones():
            busy = any(link.pending for link in entry.links.values())
            if entry.idle is not None and entry.idle.passed(busy):
                self.end(entry, f"it was idle for more than {entry.idle.limit_s:g} s")

    def _pidfd_for(self, request: m.Deposit) -> int | None:
        entry = self._jails.get(request.jail)
        if entry is None or entry.session != request.session or entry.death is not None:
            return None
        if request.runner not in entry.links:
            return None
        pidfd = entry.jail.runner_pidfd(request.runner) if entry.kept else entry.jail.pidfd
        return pidfd if pidfd >= 0 else None

    def _follow_writes(self, link: RunnerLink) -> None:
        if link.wants_write != link.watched:
            link.watched = link.wants_write
            self._loop.watch_writes(link.fileno(), link.watched)

    def _owned(self, asker: Asker, number: int, operation: str = "") -> JailEntry | None:
        entry = self._jails.get(number)
        if entry is None or entry.session != asker.session:
            self._answers.refuse(
                asker, "WorkerDiedError", f"there is no jail {number}; it has been closed"
            )
            return None
        if entry.death is not None:
            self._answers.reply(asker, for_operation(entry.death, operation))
            return None
        return entry

    def close_jail(self, asker: Asker, request: m.CloseJail) -> None:
        """End a jail; also after its death, for ``Done`` means that nothing of it is left."""
        entry = self._jails.get(request.jail)
        if entry is None or entry.session != asker.session:
            self._answers.reply(asker, m.Done())
        elif entry.released:
            del self._jails[entry.number]
            self._answers.reply(asker, m.Done())
        else:  # also after its death: Done means that nothing of it is left
            entry.closing.append(asker)
            self._kill(entry)

    def read_output(self, asker: Asker, request: m.ReadOutput) -> None:
        """Tell the last lines that a jail printed."""
        entry = self._owned(asker, request.jail, request.operation)
        if entry is not None:
            if entry.idle is not None:
                entry.idle.begin()  # so that the request that follows finds it alive
            entry.output.read()
            self._answers.reply(asker, m.Output(entry.output.text()))

    def follow_output(self, asker: Asker, request: m.FollowOutput) -> None:
        """Tell what a jail has printed since, also if it is dead."""
        entry = self._jails.get(request.jail)
        if entry is None or entry.session != asker.session:
            self._answers.refuse(asker, "WorkerError", f"there is no jail {request.jail}")
            return
        entry.output.read()
        self._answers.reply(asker, m.OutputBytes(*entry.output.since(request.offset)))

    def status(self, asker: Asker, request: m.GetStatus) -> None:
        """Tell what the asker's jails are doing."""
        mine = [entry for entry in self._jails.values() if entry.session == asker.session]
        self._answers.reply(asker, m.Status(tuple(status_of(entry) for entry in mine)))

    # --- for the gate --------------------------------------------------------------------------

    def open_ones(self, owner: bytes = b"") -> list[JailEntry]:
        """Jails that live, of sessions whose name begins like that."""
        return [
            entry
            for entry in self._jails.values()
            if entry.death is None and not entry.closing and entry.session.startswith(owner)
        ]

    def statuses(self, owner: bytes) -> list[dict[str, object]]:
        """What the jails of a session are doing."""
        return [status_of(entry) for entry in self.open_ones(owner)]

    def end(self, entry: JailEntry, why: str) -> None:
        """End a jail that nobody closes; its client is told why if it comes back."""
        self._end(entry, m.Died(-1, "idle", None, None, why, "", ""))

    def _forget_some(self) -> None:
        """The oldest dead, where there are many: their clients do not come back for them."""
        dead = [number for number, one in self._jails.items() if one.released]
        for number in dead[:-MAX_DEAD]:
            del self._jails[number]

    # --- what happens --------------------------------------------------------------------------

    def _runner_ready(self, entry: JailEntry, runner: int) -> None:
        link = entry.links[runner]
        link.flush()
        try:
            answers = link.receive()
        except ProtocolError as error:
            self._runner_died(entry, m.Died(runner, "protocol", None, None, str(error), "", ""))
            return
        if answers is None:
            self._loop.unwatch(link.fileno())
            return  # its exit says more
        self._follow_writes(link)
        if entry.idle is not None:
            entry.idle.begin()
        for packet, (pending, index) in answers:
            pending.replies[index] = packet.frames
            self._gather(pending)

    def _gather(self, pending: Pending) -> None:
        replies = [frames for frames in pending.replies if frames is not None]
        if len(replies) == len(pending.replies):
            payload = [frame for frames in replies for frame in frames]
            counts = tuple(map(len, replies))
            dead = tuple(sorted(pending.dead))
            answer = m.RelayedPartly(counts, dead) if dead else m.Relayed(counts)
            self._answers.reply(pending.asker, answer, payload)

    def _read_output(self, entry: JailEntry) -> None:
        entry.output.read()
        if entry.output.ended:
            self._loop.unwatch(entry.output.fileno())
            entry.output.close()

    def _jail_events(self, entry: JailEntry) -> None:
        events = entry.jail.poll()
        if entry.jail.fileno() < 0:
            self._unwatch_control(entry)
        for event in events:
            if isinstance(event, RunnerStarted):
                self._runner_started(entry, event)
            elif isinstance(event, Failed):
                self._failed(entry, event)
            elif isinstance(event, RunnerExited):
                self._runner_exited(entry, event)

    def _runner_started(self, entry: JailEntry, event: RunnerStarted) -> None:
        entry.pids[event.runner_id] = event.pid
        entry.report = tuple(event.report)
        for opening in list(entry.opening):
            opening.waiting.discard(event.runner_id)
            if not opening.waiting:
                entry.opening.remove(opening)
                opened = m.JailOpened(entry.number, opening.runners, entry.report)
                self._answers.reply(opening.asker, opened)

    def _failed(self, entry: JailEntry, event: Failed) -> None:
        for opening in entry.opening:
            self._answers.refuse(
                opening.asker, "SandboxUnavailableError", event.reason, event.layer, event.fix
            )
        entry.opening.clear()
        self._end(entry, m.Died(-1, "unavailable", None, None, event.reason, "", ""))

    def _runner_exited(self, entry: JailEntry, event: RunnerExited) -> None:
        how = signal_name(event.signal)
        self._runner_died(
            entry, m.Died(event.runner_id, event.reason, event.code, how, event.detail, "", "")
        )

    def _runner_died(self, entry: JailEntry, death: m.Died) -> None:
        """The end of its jail too, unless that is kept."""
        if not entry.kept:
            self._end(entry, death)
        elif entry.death is None and death.runner in entry.links:
            self._lose(entry, death)

    def _lose(self, entry: JailEntry, death: m.Died) -> None:
        """Go on without a runner: whoever waits for it hears how it died, and nobody else."""
        entry.output.read()
        death = m.replace(death, tail=entry.output.text())
        # the last lines of earlier deaths have been told: many of them would be much
        entry.lost = {runner: m.replace(one, tail="") for runner, one in entry.lost.items()}
        entry.lost[death.runner] = death
        entry.jail.kill_runner(death.runner)  # it may live, and have broken the rules
        entry.pids.pop(death.runner, None)
        close_fds(self._deposits.take(entry.number, death.runner))
        if entry.idle is not None:
            entry.idle.forget(death.runner)
        link = entry.links.pop(death.runner)
        self._loop.unwatch(link.fileno())
        for pending, index in link.pending.values():
            pending.lost(index, death)
            self._gather(pending)
        link.close()
        for opening in [one for one in entry.opening if death.runner in one.waiting]:
            entry.opening.remove(opening)
            self._answers.reply(opening.asker, for_operation(death, "start"))

    def _end(self, entry: JailEntry, death: m.Died) -> None:
        """Write the jail's death down, tell everybody who waits, and make it true."""
        if entry.death is not None:
            return
        entry.output.read()
        entry.death = death = m.replace(death, tail=entry.output.text())
        for pending in waiting(entry):
            self._answers.reply(pending.asker, for_operation(death, pending.operation))
        for opening in entry.opening:
            self._answers.reply(opening.asker, for_operation(death, "start"))
        entry.opening.clear()
        self._kill(entry)

    def _kill(self, entry: JailEntry) -> None:
        self._deposits.drop(entry.number)
        self._unwatch_control(entry)
        entry.jail.kill()

    def _unwatch_control(self, entry: JailEntry) -> None:
        """Once: after that the number may be another's."""
        self._loop.unwatch(entry.control)
        entry.control = -1

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
            self._jail_events(entry)  # its runners' exits say more than its own
            how = signal_name(event.signal)
            self._end(entry, m.Died(-1, "exit", event.code, how, "", "", ""))
        self._release(entry)
        for asker in entry.closing:
            self._answers.reply(asker, m.Done())

    def _release(self, entry: JailEntry) -> None:
        entry.released = True
        for link in entry.links.values():
            self._loop.unwatch(link.fileno())
            link.close()
        self._loop.unwatch(entry.output.fileno())
        entry.output.close()
        self._unwatch_control(entry)
        if entry.idle is not None:
            entry.idle.close()
        for pending in waiting(entry):
            death = m.Died(-1, "killed", None, None, "the jail was closed", "", pending.operation)
            self._answers.reply(pending.asker, death)
        self._forget_some()

    def _zygote_died(self, key: tuple[object, ...], event: ZygoteDied) -> None:
        spawner = self._spawners.pop(key)
        self._loop.unwatch(spawner.fileno())
        for entry in list(self._jails.values()):
            if entry.spawner == key and not entry.released:
                self._end(entry, m.Died(-1, "zygote", event.code, None, event.log, "", ""))
                self._release(entry)
        spawner.close()


_ZYGOTE_FIELDS = ("profile", "network", "readable", "gpu")
