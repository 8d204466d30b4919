"""The life of one environment, from its first jail to its last.

A session has a ``Lease`` (its jail, and the lane there), a ``UseLock`` (one thread at a time), a
``Prewarm`` (its start), ``Requests`` (for ``vector_env``) and, with ``restart="transparent"``, a
``Recovery``. None of these knows the session. The session itself recovers before a reset, closes,
and refuses all use in a fork, by the rules of docs/internals/interruption.md.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any, cast

from envhub_sandbox.errors import (
    EnvHubError,
    WorkerDiedError,
    WorkerError,
    WorkerTimeoutError,
)
from envhub_sandbox.session.builder import JailSource
from envhub_sandbox.session.counters import LEDGER, Counters, Labels
from envhub_sandbox.session.failures import Failures, Recovery, Restarts
from envhub_sandbox.session.lease import Lease
from envhub_sandbox.session.prewarm import INTERRUPT_S, LOOK_S, Prewarm
from envhub_sandbox.session.recorder import Recorder, recorder_for
from envhub_sandbox.session.repository import Repository
from envhub_sandbox.session.requests import Requests
from envhub_sandbox.session.use_lock import UseLock
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system import extras
from envhub_sandbox.system.log import WORKER
from envhub_sandbox.system.platform import each_after_fork
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.replies import RunnersDiedError
from envhub_sandbox.transport.results import Results
from envhub_sandbox.transport.shard_trials import ShardTrials
from envhub_worker.protocol.lifecycle import Event, Lifecycle, State
from envhub_worker.protocol.manifest.manifest import EnvManifest

_USAGE = ("processes", "threads", "files", "memory_bytes")
_MOST = 1 << 63
"""The limit of plausible counts, since a server on another host may send any number."""
GRACE_S = 2.0
"""How long ``reset`` waits for a late reply before it gives the jail up and starts another."""


class EnvSession:
    """The life of one vector environment, which has at most one jail at a time.

    One thread at a time may use it; any thread and any signal handler may call ``close`` at any
    time.

    Args:
        bounds: The slices of its sub-environments, one for each shard.
        trials: Remembers the time of its steps.
        whole: The recorder of the whole environment if this session is one worker of several, in
            which case the whole environment is counted, not this worker.
    """

    def __init__(
        self,
        jails: JailSource,
        manifest: EnvManifest,
        bounds: Sequence[tuple[int, int]],
        trials: ShardTrials,
        whole: Recorder | None = None,
    ) -> None:
        self.repository: Repository = jails.launcher.repository
        policy = self.repository.policy
        self.manifest = manifest
        self.bounds = list(bounds)
        self.lifecycle = Lifecycle()
        self.counters = counters = Counters()
        self.recorder = recorder = (
            recorder_for(policy.crash_history) if whole is None else whole.of_part()
        )
        results = Results(manifest, self.bounds)
        self.lease = lease = Lease(jails, results, self.lifecycle, counters, trials)
        self.report, self.denials = lease.report, lease.denials
        self._restarts = Restarts(policy, counters)
        self._failures = failures = Failures(lease, recorder)
        self.use = use = UseLock(lease, failures)
        recovery: Recovery | None = None
        if policy.restart == "transparent":
            asked = option_name("restart", policy.restart)
            made = extras.required("envhub_sandbox.extras.restart.recovery", "Recovery", asked)
            recovery = made(lease, self._restarts, failures, recorder)
        self.prewarm = Prewarm(lease, use, recorder, recovery)
        self.prewarms = [self.prewarm]
        self.requests = Requests(lease, use, self.prewarm, recorder, failures, recovery)
        labels = Labels(self.repository.label, manifest.suite, str(manifest.task))
        if whole is None:
            LEDGER.add(self, labels, counters, self.lifecycle)
        _living.add(self)  # for a fork, which must touch nothing of it

    jails = 1
    """The number of jails that it uses at a time."""

    @property
    def rows(self) -> tuple[int, int]:
        """The first of its sub-environments, and the one after the last."""
        return self.bounds[0][0], self.bounds[-1][1]

    def usage(self) -> dict[str, int]:
        """What its jail uses, as counted by the server; empty if the server does not say."""
        status = self.lease.status()
        counts = {name: status.get(name) for name in _USAGE}
        valid = all(type(count) is int and 0 <= count < _MOST for count in counts.values())
        return cast("dict[str, int]", counts) if valid else {}

    def stats(self) -> dict[str, Any]:
        """The counters and the state."""
        return {**self.counters.snapshot(), "state": self.lifecycle.state.name}

    @property
    def may_take_apart(self) -> bool:
        """Whether ``take_apart`` can ask the processes now, or needs to ask none."""
        return self.lease.lane is None or self.lifecycle.state is State.READY

    def take_apart(self, deadline: Deadline, *, single: bool = False) -> bool:
        """Have infos come apart, as ``Results.apart`` says; returns whether they do.
        ``single``: also have nobody but the caller reset it, as ``Results.single`` says.
        """
        with self.use.hold("make_env"):
            results = self.lease.results
            if (not results.apart or single > results.single) and self.may_take_apart:
                results.single = results.single or single
                self.lease.take_apart(deadline)
            return results.apart

    # --- recovery --------------------------------------------------------------------------------

    def recover(self, grace: Deadline | None = None) -> None:
        """Before a reset, take a late reply, or give up the jail that owes it.

        A reply whose wait was interrupted counts as late. After a death, a fresh jail is started
        only if the policy says ``restart="on_reset"``.
        ``grace`` bounds the wait for late replies; several workers share one.
        """
        ready = self.lifecycle.state is State.READY and not self.prewarm.unused
        if ready and self.repository.timeouts.idle_s is None:
            return
        with self.use.hold("reset"):
            # The order matters, since each step may move the state to one that a later step
            # handles:
            #
            # 1. A jail that was started ahead and has died unnoticed becomes EXPIRED.
            # 2. PENDING becomes LATE: this thread holds the lock, so the pending request was
            #    interrupted.
            # 3. READY becomes EXPIRED if the server has ended an idle jail.
            # 4. EXPIRED becomes IDLE; the next request opens a new jail.
            # 5. LATE becomes READY if the reply still comes, otherwise IDLE.
            # 6. DEAD becomes IDLE, at the cost of one restart.
            self.prewarm.look_whether_it_lives()
            if self.lifecycle.state is State.PENDING:
                self._failures.note_interruption()
            if self.lifecycle.state is State.READY and self.repository.timeouts.idle_s is not None:
                self._see_whether_it_expired()
            if self.lifecycle.state is State.EXPIRED:
                self._forget()
            if self.lifecycle.state is State.LATE:
                self._catch_up(grace or Deadline(GRACE_S))
            if self.lifecycle.state is State.DEAD and self._restarts.permitted:
                self._restarts.spend("reset")
                self._forget()

    def notice_death(self) -> None:
        """Before a reset, after another worker has died, check whether this worker died too."""
        if self.lifecycle.state is State.READY:
            with self.use.hold("reset"):
                try:
                    self.lease.look("reset", Deadline(LOOK_S))
                except WorkerDiedError as error:
                    self._failures.dead(error)

    def _catch_up(self, grace: Deadline) -> None:
        lane, request = self.lease.lane, self.lifecycle.request
        try:
            if lane is None or request is None:
                raise WorkerError("the jail was given up, or how far the request came is not known")
            self.lease.forget_watched()  # an interrupt may have come before the wait
            lane.catch_up(grace)
        except RunnersDiedError:
            pass  # the reset that follows handles the deaths
        except (WorkerDiedError, WorkerTimeoutError) as error:
            error.request = request
            self._failures.keep_crash(error)
            self._forget()
            return
        except EnvHubError:
            self._forget()
            return
        self.lifecycle.answered()

    def _see_whether_it_expired(self) -> None:
        try:
            self.lease.look("reset", Deadline(LOOK_S))
        except WorkerDiedError as error:
            if error.reason == "idle":
                self.lifecycle.moved(Event.EXPIRY)
        # the reset that follows handles any other death

    def _forget(self) -> None:
        """Give up the jail; the next request opens a new one in the same server."""
        WORKER.info("%s: the jail is given up for a fresh one", self.repository.label)
        self.lease.leave()
        self.lifecycle.request = None
        self.lifecycle.moved(Event.FORGET)

    # --- close -----------------------------------------------------------------------------------

    def close(self) -> None:
        """Close the environment and end its processes, in bounded time, from any thread.

        Idempotent; after a Ctrl-C, the next call finishes the work.
        """
        if self.lifecycle.closed:
            self._finish()
            return
        if self.lifecycle.state is State.FOREIGN:
            self.lifecycle.on(Event.CLOSE)
            return
        if not self.use.lock.acquire(blocking=False):
            self._interrupt()
            return
        # interruption.md, rules 7, 9 and 11. This thread has taken the lock, so no request runs.
        # The order matters:
        #
        # 1. The state becomes CLOSED: from then on no other thread starts anything.
        # 2. The time of steps is noted while the lane still exists.
        # 3. The repository's own ``close`` runs, but only if no reply is owed: a busy runner would
        #    not answer in time.
        # 4. The jail is given back.
        # 5. The lock is released whatever fails, or every later ``close`` would take this one for
        #    a running request.
        #
        # After an interrupt the state is CLOSED, and the next ``close`` continues in ``_finish``.
        try:
            state = self.lifecycle.state
            self._end_life()
            self.lease.note_steps()
            if state is State.READY:
                self.lease.close_politely()
        finally:
            try:
                self.lease.let_go(wait=False)
            finally:
                self.use.lock.release()

    finalize = close
    """The function for a finalizer to call."""

    def _finish(self) -> None:
        if self.use.lock.acquire(blocking=False):  # else another thread is closing it
            try:
                self.lease.let_go()
            finally:
                self.use.lock.release()

    def _end_life(self) -> None:
        self.lifecycle.moved(Event.CLOSE)
        self._restarts.give_up()

    def _interrupt(self) -> None:
        """End the jail whose reply another thread waits for, then give it back: interruption.md,
        rule 11. If that thread does not release the lock in time, it gives the jail back itself.
        """
        # The other thread holds the lock and may wait without end. So the order is:
        #
        # 1. Under the lease's own lock, the state becomes CLOSED and the jail is ended. A thread
        #    that is taking a jail at this moment either sees CLOSED and gives its jail back, or
        #    has noted the jail, which is then ended.
        # 2. The end of the jail wakes the other thread, which releases the environment's lock.
        # 3. We take that lock, waiting for at most ``patience_s`` because ``close`` is bounded,
        #    and give back what is left.
        if not self.lease.interrupt(self._end_life):
            # The other thread checks for CLOSED when it has taken a jail, but it may have passed
            # that check already, so the server is released here.
            self.lease.depart()
            return
        close_s = self.repository.timeouts.close_s
        patience_s = INTERRUPT_S if close_s is None else min(close_s, INTERRUPT_S)
        if self.use.lock.acquire(timeout=patience_s):
            try:
                self.lifecycle.moved(Event.CLOSE)  # the other thread may have moved it
                self.lease.let_go()  # also of a jail that the other thread took meanwhile
            finally:
                self.use.lock.release()

    def abandon(self) -> None:
        """In a fork: touch nothing, and refuse all requests. interruption.md, rule 14."""
        self.use.abandon()
        self.lifecycle.moved(Event.FORK)
        self.lifecycle.request = self.requests.stepping = None
        self.lease.abandon()


_living: weakref.WeakSet[EnvSession] = weakref.WeakSet()
each_after_fork(_living, EnvSession.abandon)  # interruption.md, rule 14
