"""Handles events of jails: they start, answer, print, break rules and die.

``jails.py`` handles requests; actions that events and requests share, such as the end of a jail,
are here. Trust: a runner is hostile. The server does not decode its messages and checks only their
sizes and order; a runner that breaks the rules loses its jail.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from time import monotonic

from envhub_worker.lockdown.limits.cgroups import OUTER_LIMIT, SurroundingLimit
from envhub_worker.loop import Loop
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.errors import ProtocolError
from envhub_worker.spawn.channel import close_fds
from envhub_worker.spawn.jail import CallDenied, JailFailed, RunnerExited, RunnerStarted
from envhub_worker.spawn.spawner import JailExited, ZygoteDied
from envhub_worker.supervisor.fd_store import FdStore
from envhub_worker.supervisor.records import (
    JailRecord,
    Pending,
    RefusedError,
    Reply,
    Witness,
    signal_name,
    waiting,
    whole_jail,
)
from envhub_worker.supervisor.runner_stream import RunnerLink
from envhub_worker.supervisor.served_slabs import ServedSlabs, ServedSteps

MAX_DEAD = 256
"""Jails that have ended and are not closed, whose deaths are remembered."""


class JailEvents:
    """Records events of jails and answers the requests that wait for them.
    ``jails``: all jails of the server; this class removes those that ended long ago.
    ``deaths``: how many jails, and runners of kept jails, have ended unasked, by reason.
    """

    def __init__(
        self, loop: Loop, reply: Reply, jails: dict[int, JailRecord], fds: FdStore, witness: Witness
    ) -> None:
        self._loop = loop
        self._reply = reply
        self._jails = jails  # the dict of ``Jails``, which adds to it
        self._fds = fds  # deposits of jails and runners that end here are closed
        self._witness = witness  # hears of openings and deaths
        self.deaths: Counter[str] = Counter()
        self._steps = ServedSteps()  # steps that runners owe the server itself
        loop.watch(self._steps.fileno(), self._steps.rung)
        # Before the loop sleeps: an answer in slabs that the server polls wakes nobody.
        loop.look_by(self._steps.look)
        self._outer_limit = SurroundingLimit()

    def follow(self, entry: JailRecord) -> None:
        """Watch a new jail."""
        self._watch(entry, entry.control, partial(self._jail_events, entry))
        self._watch(entry, entry.output.fileno(), partial(self._read_output, entry))

    def follow_runner(self, entry: JailRecord, runner: int) -> None:
        """Watch a new runner."""
        self._watch(entry, entry.links[runner].fileno(), partial(self._runner_ready, entry, runner))

    def _watch(self, entry: JailRecord, fd: int, callback: Callable[[], None]) -> None:
        self._loop.watch(fd, self._guarded(entry, callback))

    def _guarded(self, entry: JailRecord, callback: Callable[[], None]) -> Callable[[], None]:
        """Returns a callback whose exceptions end the jail instead of the server."""

        def guarded() -> None:
            try:
                callback()
            except Exception as error:
                self._witness.failed(error)
                failure = f"an error of the worker server: {type(error).__name__}: {error}"
                self.end(entry, whole_jail("killed", detail=failure))

        return guarded

    def share(self, link: RunnerLink, slabs: ServedSlabs) -> None:
        """Step a runner by these slabs from now on."""
        self._part_with(link)
        link.slabs = slabs
        self._steps.add(slabs)

    def _part_with(self, link: RunnerLink) -> None:
        if link.slabs is not None:
            self._steps.forget(link.slabs)
            link.slabs = None

    def step(self, entry: JailRecord, link: RunnerLink, frame: bytes, owner: object) -> None:
        """Have a runner take a step."""
        assert link.slabs is not None
        link.sent += len(frame)
        link.slabs.ask(frame, owner)
        if link.take is None:
            link.take = self._guarded(entry, partial(self._stepped, entry, link))
        self._steps.owe(link.slabs, link.take)

    def _stepped(self, entry: JailRecord, link: RunnerLink) -> None:
        """Take a runner's answer to a step, if there is one. Its request may be gone by now."""
        if link.slabs is None or link.slabs.owner is None or not link.slabs.answered:
            return
        (pending, index), frames = link.slabs.take()
        link.received += sum(map(len, frames))
        if entry.idle is not None:
            entry.idle.begin()
        pending.replies[index] = frames
        self.gather(pending)

    def follow_writes(self, link: RunnerLink) -> None:
        """Watch a runner's socket for writing while something is unsent."""
        if link.wants_write != link.watched:
            link.watched = link.wants_write
            self._loop.watch_writes(link.fileno(), link.watched)

    def _runner_ready(self, entry: JailRecord, runner: int) -> None:
        link = entry.links[runner]
        # The loop calls back for both directions with one function: the socket may take more, too.
        link.flush()
        try:
            answers = link.receive()
        except ProtocolError as error:
            self._runner_died(entry, m.Death(runner, "protocol", detail=str(error)))
            return
        if answers is None:
            self._loop.unwatch(link.fileno())
            return  # its exit says more
        self.follow_writes(link)
        if entry.idle is not None:
            entry.idle.begin()
        for packet, (pending, index) in answers:
            pending.replies[index] = packet.frames
            self.gather(pending)

    def gather(self, pending: Pending) -> None:
        """Answer a ``Relay`` if each of its runners has answered or died."""
        # One reply for all runners of a request: the client never has half of a step.
        replies = [frames for frames in pending.replies if frames is not None]
        if len(replies) == len(pending.replies):
            payload = [frame for frames in replies for frame in frames]
            counts = tuple(map(len, replies))
            dead = tuple(sorted(pending.dead)) if pending.dead else ()
            self._reply(pending.asker, m.RelayDone(counts, dead), payload)

    def _read_output(self, entry: JailRecord) -> None:
        entry.output.read()
        if entry.output.ended:
            self._loop.unwatch(entry.output.fileno())
            entry.output.close()

    def catch_up(self, entry: JailRecord) -> None:
        """Handle a jail's waiting events now, which the loop would handle a moment later."""
        if entry.death is None and entry.jail.fileno() >= 0:
            self._jail_events(entry)

    def _jail_events(self, entry: JailRecord) -> None:
        events = entry.jail.poll()
        if entry.jail.fileno() < 0:
            self._unwatch_control(entry)
        for event in events:
            if isinstance(event, RunnerStarted):
                self._runner_started(entry, event)
            elif isinstance(event, JailFailed):
                self._failed(entry, event)
            elif isinstance(event, RunnerExited):
                self._runner_exited(entry, event)
            elif isinstance(event, CallDenied):
                entry.denied.append(f"{event.call} {event.detail}".strip())

    def _runner_started(self, entry: JailRecord, event: RunnerStarted) -> None:
        entry.pids[event.runner] = event.pid
        for opening in list(entry.opening):
            opening.waiting.discard(event.runner)
            if not opening.waiting:
                entry.opening.remove(opening)
                opened = m.JailOpened(entry.number, opening.runners, tuple(event.report))
                self._reply(opening.asker, opened)
                took = monotonic() - opening.since
                self._witness.opened(entry, len(opening.runners), took)
                entry.opened = True

    def _failed(self, entry: JailRecord, event: JailFailed) -> None:
        for opening in entry.opening:
            why = ("SandboxUnavailableError", event.reason, event.layer, event.fix)
            self._reply(opening.asker, RefusedError(*why).reply)
        entry.opening.clear()
        self.end(entry, whole_jail("unavailable", detail=event.reason))

    def _runner_exited(self, entry: JailRecord, event: RunnerExited) -> None:
        death = m.Death(
            event.runner,
            event.reason,
            exit_code=event.code,
            signal=signal_name(event.signal),
            detail=event.detail,
        )
        self._runner_died(entry, self._judged(entry, death))

    def _judged(self, entry: JailRecord, death: m.Death) -> m.Death:
        """Report a SIGKILL as out-of-memory if the kernel counted it for the server's own limit."""
        by_signal = death.signal == "SIGKILL" and death.reason in ("signal", "exit")
        if entry.death is None and by_signal and self._outer_limit.killed_one():
            return m.replace(death, reason="out-of-memory", detail=OUTER_LIMIT)
        return death

    def close(self) -> None:
        """Report the last jails as closed, at the end of the server."""
        for entry in self._jails.values():
            if entry.death is None and not entry.released:
                self._witness.closed(entry)
        self._steps.close()
        self._outer_limit.close()

    def _runner_died(self, entry: JailRecord, death: m.Death) -> None:
        """End the jail of a dead runner, unless the client keeps it (``KeepJail``)."""
        if not entry.kept:
            self.end(entry, death)
        elif entry.death is None and death.runner in entry.links:
            self._lose(entry, death)

    def _lose(self, entry: JailRecord, death: m.Death) -> None:
        """Go on without a runner, and answer the requests that wait for it with its death."""
        # In this order. The runner is killed first: it may live and have broken the rules. Its last
        # step is taken before the waiting requests are answered, for it may have finished that
        # step. The slabs and the stream are closed only when nobody reads them any more.
        self.deaths[death.reason] += 1
        entry.output.read()
        death = m.replace(death, tail=entry.output.text())
        # The clients have the output of earlier deaths already; drop it to save memory.
        entry.lost = {runner: m.replace(lost, tail="") for runner, lost in entry.lost.items()}
        entry.lost[death.runner] = death
        entry.jail.kill_runner(death.runner)  # it may live, and have broken the rules
        entry.pids.pop(death.runner, None)
        close_fds(self._fds.take(entry.number, death.runner))
        if entry.idle is not None:
            entry.idle.forget(death.runner)
        link = entry.drop(death.runner)
        self._loop.unwatch(link.fileno())
        self._stepped(entry, link)  # it may have answered before
        for pending, index in link.owed:
            pending.lost(index, death)
            self.gather(pending)
        self._part_with(link)
        link.close()
        for opening in list(entry.opening):
            if death.runner in opening.waiting:
                entry.opening.remove(opening)
                self._reply(opening.asker, m.replace(death, operation="start"))
        self._witness.lost(entry, death)

    def end(self, entry: JailRecord, death: m.Death) -> None:
        """Record the jail's death, answer all waiting requests, and kill its processes."""
        # In this order. Denials, finished steps and output that still wait in the jail's channels
        # are read first. Then ``entry.death`` is set, so that a second ``end`` returns at once.
        # Requests are answered from it, and only then are the processes killed.
        if entry.death is not None:
            return
        self.deaths[death.reason] += 1
        self._hear_last(entry)
        for link in entry.links.values():
            self._stepped(entry, link)  # it may have answered before
        entry.output.read()
        entry.death = death = m.replace(death, tail=entry.output.text())
        for pending in waiting(entry):
            self._reply(pending.asker, m.replace(death, operation=pending.operation))
        for opening in entry.opening:
            self._reply(opening.asker, m.replace(death, operation="start"))
        entry.opening.clear()
        self._witness.died(entry)
        self.kill(entry)

    def _hear_last(self, entry: JailRecord) -> None:
        """Read the last denials from the control channel before the jail ends.

        An unreadable channel must not keep the jail from ending.
        """
        try:
            events = entry.jail.poll()
        except Exception as error:
            self._witness.failed(error)
            return
        for event in events:
            if isinstance(event, CallDenied):
                entry.denied.append(f"{event.call} {event.detail}".strip())

    def kill(self, entry: JailRecord) -> None:
        """Start to end a jail's processes; ``jail_gone`` follows when all have ended."""
        self._fds.drop(entry.number)
        self._unwatch_control(entry)
        entry.jail.kill()

    def _unwatch_control(self, entry: JailRecord) -> None:
        """Stop watching the control channel, once: its number may belong to another file later."""
        self._loop.unwatch(entry.control)
        entry.control = -1

    def jail_gone(self, event: JailExited) -> None:
        """Release a jail whose processes have all ended, and answer requests that wait for that."""
        entry = next((jail for jail in self._jails.values() if jail.jail is event.jail), None)
        if entry is None:
            return
        if entry.closing:
            del self._jails[entry.number]
        else:
            self._jail_events(entry)  # its runners' exits say more than its own
            how = signal_name(event.signal)
            death = whole_jail("exit", exit_code=event.code, signal=how)
            self.end(entry, self._judged(entry, death))
        self._release(entry)
        for asker in entry.closing:
            self._reply(asker, m.Done())
        if entry.death is None:
            self._witness.closed(entry)

    def _release(self, entry: JailRecord) -> None:
        entry.released = True
        self._fds.drop(entry.number)  # its client may have brought some while it ended
        unanswered = waiting(entry)  # before the slabs go, whose steps are among them
        for link in entry.links.values():
            self._loop.unwatch(link.fileno())
            self._part_with(link)
            link.close()
        self._loop.unwatch(entry.output.fileno())
        entry.output.close()
        self._unwatch_control(entry)
        if entry.idle is not None:
            entry.idle.close()
        for pending in unanswered:
            death = whole_jail("killed", detail="the jail was closed")
            self._reply(pending.asker, m.replace(death, operation=pending.operation))
        # Forget the oldest of many dead jails: their clients have not asked about them for long.
        dead = [number for number, jail in self._jails.items() if jail.released]
        for number in dead[:-MAX_DEAD]:
            del self._jails[number]

    def zygote_died(self, key: tuple[object, ...], event: ZygoteDied) -> None:
        """End every jail of a zygote that has ended."""
        for entry in list(self._jails.values()):
            if entry.zygote == key and not entry.released:
                self.end(entry, whole_jail("zygote", exit_code=event.code, detail=event.log))
                self._release(entry)
