"""One task's environment: what is asked of it, in which state it is, and what comes back.

``vector_env`` asks it for replies and knows nothing of jails; ``Lifecycle`` says what is legal. It
*has* a ``Lease``, whose lane takes each request to the shards, and a ``Recovery``, which stands in
for those that die. None of these knows it.
"""

from __future__ import annotations

import contextlib
import os
import threading
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn, TypeVar

from envhub_sandbox.crash.history import History
from envhub_sandbox.errors import (
    EnvHubError,
    LocalProtocolError,
    RemoteProtocolError,
    WorkerDiedError,
    WorkerError,
    WorkerTimeoutError,
)
from envhub_sandbox.log import WORKER
from envhub_sandbox.session.concurrent import collision
from envhub_sandbox.session.counters import LEDGER, Counters, Labels
from envhub_sandbox.session.failures import Failures, refusal
from envhub_sandbox.session.jail_sources import JailSource
from envhub_sandbox.session.launcher import LoadedJail, Repository
from envhub_sandbox.session.lease import Lease, closed_during
from envhub_sandbox.session.recovery import Fail, Recovery, Revive
from envhub_sandbox.session.restart_policy import Restarts
from envhub_sandbox.transport.deadline import Deadline, StartupDeadline, StepDeadline
from envhub_sandbox.transport.jail import RunnersDiedError, check, typed
from envhub_sandbox.transport.lane import Lane
from envhub_sandbox.transport.results import Results, StepResult
from envhub_sandbox.transport.shared_memory.sharding import PaceBook
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import Event, Lifecycle, State
from envhub_worker.protocol.manifest import EnvManifest
from envhub_worker.protocol.spaces import batches
from envhub_worker.protocol.untrusted import blamed, is_fault

_GRACE_S = 2.0
"""How long ``reset`` waits for a late reply before it gives the jail up and starts another."""
_LOOK_S = 10.0
_INTERRUPT_S = 10.0
"""How long ``close`` waits at most for another thread to notice that the jail has gone: no longer
than it waits for the environment's own ``close``."""

MessageFor = Callable[[int, tuple[int, int]], m.Message]
"""Makes the message for a shard out of the environment's number and the shard's bounds."""
T = TypeVar("T")


class EnvSession:
    """The life of one vector environment, in one jail at a time, or none.

    Safe to use from one thread at a time; ``close`` may come from any thread at any time, and from
    a signal handler.

    Args:
        jails: Gives and takes back the jail.
        manifest: What the environment is expected to be.
        bounds: The slices of its sub-environments, one for each shard.
        paces: Takes note of what its steps took.
    """

    def __init__(
        self,
        jails: JailSource,
        manifest: EnvManifest,
        bounds: Sequence[tuple[int, int]],
        paces: PaceBook,
    ) -> None:
        policy = jails.repository.policy
        self.repository: Repository = jails.repository
        self.manifest = manifest
        self.bounds = list(bounds)
        self.lifecycle = Lifecycle()
        self.counters = Counters()
        self.history = History(manifest, policy.crash_history)
        self.results = Results(manifest, self.bounds)
        self.lease = Lease(jails, self.results, self.lifecycle, self.counters, paces)
        self._restarts = Restarts(policy)
        self._failures = Failures(self.lease, self.results, self.counters, self.history)
        self._recovery: Recovery = Fail()
        if policy.restart == "transparent":
            self._recovery = Revive(self.lease, self.results, self._restarts, self._failures)
        self._lock = threading.RLock()  # a signal handler may close what its own thread waits for
        self._step_deadline = StepDeadline(jails.repository.timeouts.step_s)
        self._warm = False  # started ahead, and not used yet
        self._warming: StartupDeadline | None = None
        self._first_use: Callable[[], None] | None = None
        self._interruption: str | None = None  # the request that is late for that reason
        labels = Labels(self.repository.label, manifest.suite, str(manifest.task))
        LEDGER.add(self, labels, self._restarts)
        _living.add(self)

    @property
    def closed(self) -> bool:
        """Whether it is closed for good."""
        return self.lifecycle.closed

    def report(self) -> list[dict[str, Any]]:
        """The layers of the jail that it lives in; none where it does not live in any."""
        return self.lease.report()

    def stats(self) -> dict[str, Any]:
        """Counters, and where it is in its life."""
        found = self.counters.snapshot()
        return {**found, "restarts": self._restarts.count, "state": self.lifecycle.state.name}

    # --- requests ------------------------------------------------------------------------------

    def submit(self, operation: str, message_for: MessageFor) -> None:
        """Send a request to every shard, opening the jail if there is none.

        Raises:
            LocalProtocolError: It cannot be sent; nothing was.
            WorkerError: The environment is not in a state to take it.
        """
        with self._lock:
            try:
                self._submit(operation, message_for)
            except BaseException:
                with self._turn(operation):  # only now: what goes well has no need of it
                    raise
            if self.lifecycle.state is State.CLOSED:
                self.lease.let_go()

    def _submit(self, operation: str, message_for: MessageFor) -> None:
        self._make_ready(operation)
        lane = self._lane()
        messages = [message_for(lane.number, bounds) for bounds in self.bounds]
        try:
            request = lane.request(operation, messages)
        except LocalProtocolError:
            self._refuse_whole(operation, message_for)
            raise
        self._send(operation, lambda: lane.send(request))
        self._recovery.sent(request)
        self.history.requested(request)
        if self._first_use is not None:
            self._note_first_use()

    def _refuse_whole(self, operation: str, message_for: MessageFor) -> None:
        """Raise what cannot be sent as it is called in the caller's arguments, not in a shard's."""
        if len(self.bounds) > 1:
            lane = self._lane()
            lane.request(operation, [message_for(lane.number, (0, self.manifest.num_envs))])

    def collect(self, timeout_s: float | None) -> list[m.Message]:
        """The shards' replies to the last ``submit``; the environment is usable afterwards.

        Raises:
            WorkerTimeoutError: The environment is then LATE: ``reset`` brings it back.
            WorkerDiedError: The environment is then DEAD; with ``restart="transparent"`` READY.
            RemoteEnvError: The repository's code raised; the environment is still usable.
        """
        with self._lock:
            try:
                replies = self._collect(timeout_s)
            except BaseException:
                with self._turn("a request"), self._judging():
                    raise
            if self.lifecycle.state is State.CLOSED:
                self.lease.let_go()
            return replies

    def _collect(self, timeout_s: float | None) -> list[m.Message]:
        try:
            lane = self.lease.lane
            if lane is None or self.lifecycle.state is not State.PENDING:
                raise self._nothing_asked()
            replies = self._finish(lane.replies, Deadline(timeout_s))
        except RunnersDiedError as deaths:
            replies = self._survive_request(deaths)
        for reply in replies:
            check(reply)
        self._recovery.answered()
        return replies

    def request(
        self, operation: str, message_for: MessageFor, timeout_s: float | None
    ) -> list[m.Message]:
        """``submit`` and ``collect``."""
        self.submit(operation, message_for)
        return self.collect(timeout_s)

    @contextmanager
    def handling(self) -> Iterator[None]:
        """Handle a reply that has come: who breaks a rule in it is given up, and not asked again.

        Raises:
            RemoteProtocolError: It did, whatever the handling raised; the environment is then DEAD.
        """
        with self._turn("a request"), self._judging():
            yield

    def finish_reset(
        self, replies: list[m.ResetDone], timeout_s: float | None
    ) -> tuple[Any, dict[Any, Any]]:
        """What ``VectorEnv.reset`` returns, of the replies to one; raises as ``collect`` does."""
        with self.handling():
            try:
                return self.results.reset(replies)
            except batches.Misfit:
                return self.results.reset(replies, self._infos_apart(Deadline(timeout_s)))

    # --- steps ---------------------------------------------------------------------------------

    def submit_step(self, actions: Any) -> None:
        """Send a validated batch of actions."""
        with self._lock:
            lifecycle = self.lifecycle
            if lifecycle.state is not State.READY:
                with self._turn("step"):
                    self._make_ready("step")
            try:
                lane = self.lease.lane
                assert lane is not None
                lifecycle.request = "step"
                # first: an interrupt from here on leaves a reply that may come
                lifecycle.on(Event.SUBMIT)
                lane.send_step(actions)
            except BaseException as error:
                with self._turn("step"):
                    self._nothing_was_sent(error)
                    raise
            self.counters.requests += 1
            self.history.step(actions)  # while the jail is at it

    def collect_step(self, timeout_s: float | None) -> StepResult:
        """What ``VectorEnv.step`` returns; raises as ``collect`` does."""
        with self._lock:
            deadline: Deadline = self._step_deadline
            if timeout_s is self._step_deadline.timeout_s:
                self._step_deadline.again()
            else:
                deadline = Deadline(timeout_s)
            try:
                lane = self.lease.lane
                if lane is None or self.lifecycle.state is not State.PENDING:
                    raise self._nothing_asked()
                self._finish(lane.wait, deadline)
                self.counters.stepped(lane.elapsed_ns)
                try:
                    return lane.result()
                except batches.Misfit:
                    return lane.result(self._infos_apart(deadline))
            except RunnersDiedError as deaths:
                with self._turn("step"), self._judging():
                    return self._survive_step(deaths)
            except BaseException:
                with self._turn("step"), self._judging():
                    raise

    # --- out and back --------------------------------------------------------------------------

    def _make_ready(self, operation: str) -> None:
        if self.lifecycle.state is State.READY:
            return
        state, restart = self.lifecycle.state, self.repository.policy.restart
        # a request that is still pending here was interrupted before anybody waited
        interrupted = self.lifecycle.request if state is State.PENDING else self._interruption
        refused = refusal(state, operation, restart, interrupted)
        if refused is not None:
            self._refuse_others(operation)
            raise refused
        self._note_first_use()  # already: what is started ahead of the next is started beside this
        self._start(StartupDeadline(self.repository.timeouts.startup_s))

    def _refuse_others(self, operation: str) -> None:
        """A request that another thread waits for is not late: it is in use.

        Raises:
            AlreadyPendingCallError: It is.
        """
        if self.lifecycle.state is State.PENDING:
            found = collision(self, operation)
            if found is not None:
                raise found

    def _send(self, operation: str, send: Callable[[], None]) -> None:
        self.lifecycle.request = operation
        self.lifecycle.on(Event.SUBMIT)  # first, as for a step
        try:
            send()
        except EnvHubError as error:
            self._nothing_was_sent(error)
            raise
        self.counters.requests += 1

    def _nothing_was_sent(self, error: BaseException) -> None:
        """Go back to where we were, if the lane says so: by an error of this project."""
        if isinstance(error, EnvHubError) and self.lifecycle.state is State.PENDING:
            self._answered()

    def _answered(self) -> None:
        """Nothing is owed any more."""
        self.lifecycle.request = None
        self.lifecycle.moved(Event.REPLY)

    def _lane(self) -> Lane:
        lane = self.lease.lane
        assert lane is not None
        return lane

    def _nothing_asked(self) -> WorkerError:
        state = self.lifecycle.state.value
        return WorkerError(f"there is no request to wait for: the environment is {state}")

    def _finish(self, receive: Callable[[Deadline], T], deadline: Deadline) -> T:
        """Wait for the pending reply, and move on to the state that it leads to."""
        lifecycle = self.lifecycle
        try:
            received = receive(deadline)
        except RunnersDiedError:
            raise
        except EnvHubError as error:
            self._failed(error, deadline)
        except BaseException as error:  # Ctrl-C, or whatever else a signal handler raises or does
            self._interrupted(error)
            raise
        lifecycle.request = None
        lifecycle.moved(Event.REPLY)
        return received

    def _failed(self, error: EnvHubError, deadline: Deadline) -> NoReturn:
        """Tell of a wait that ended in an error, and move on to the state that it leads to."""
        failures, operation = self._failures, self.lifecycle.request or "a request"
        if isinstance(error, WorkerTimeoutError):
            self.counters.timeouts += 1
            self._interruption = None
            self.lifecycle.moved(Event.TIMEOUT)
            raise failures.late(operation, deadline) from error
        if isinstance(error, WorkerDiedError) and error.reason == "idle":
            raise failures.expired(operation, error.detail) from None
        if isinstance(error, WorkerError) and not self.closed:
            deaths = self._recovery.survivable(error)
            if deaths is not None:
                raise deaths from error.__cause__
        raise failures.dead(error) from error.__cause__

    def _interrupted(self, error: BaseException) -> None:
        """Nobody waits any more, but something may come.

        Raises:
            WorkerDiedError: It was a ``close`` in the midst, which took away what was waited on.
        """
        if self.closed and isinstance(error, Exception):
            raise self._failures.dead(WorkerDiedError("")) from error
        self._interruption = self.lifecycle.request or "request"
        self.lifecycle.moved(Event.INTERRUPT)

    def _infos_apart(self, deadline: Deadline) -> dict[Any, Any]:
        """The last infos, of shards that do not agree about them."""
        lane = self._lane()
        self._send("step", lane.send_for_infos)
        try:
            replies = self._finish(lane.replies, deadline)
        except RunnersDiedError as deaths:
            self._answered()  # the next request meets the deaths
            raise deaths.first from None
        for reply in replies:
            check(reply)
        return self.results.apart([typed(reply, m.Value) for reply in replies])

    @contextmanager
    def _judging(self) -> Iterator[None]:
        """``handling`` for who has the turn."""
        try:
            yield
        except Exception as error:
            # in any other state somebody has dealt with it already, or interrupted a wait
            if self.lifecycle.state is not State.READY:
                raise
            if is_fault(error):
                broken = blamed(error)
                self._failures.dead(broken)
                raise broken from error
            if isinstance(error, RemoteProtocolError):
                self._failures.dead(error)
            raise

    @contextmanager
    def _turn(self, operation: str) -> Iterator[None]:
        """Hold the lock. A ``close`` that has come when it is left, did not wait for it."""
        with self._lock, self.repository.named():
            try:
                yield
            except BaseException as error:
                self._after_close(operation, error)
                raise
            if self.lifecycle.state is State.CLOSED:
                self.lease.let_go()

    def _after_close(self, operation: str, error: BaseException) -> None:
        """What failed because of a ``close`` in its midst says so, and gives back what is left.

        Raises:
            WorkerDiedError: It was closed, and the error does not say so.
        """
        if not self.closed:
            return
        self.lease.let_go()
        if isinstance(error, Exception) and not isinstance(error, WorkerDiedError):
            raise closed_during(operation) from error

    # --- survived ------------------------------------------------------------------------------

    def _survive_request(self, deaths: RunnersDiedError) -> list[m.Message]:
        """A reset is done in fresh runners; anything else is not repeated.

        Raises:
            WorkerDiedError: It was something else; the next step or reset brings them back.
        """
        replies = self._of_survivors(deaths)
        if self.lifecycle.request != "reset":
            self._answered()
            raise deaths.first
        fresh = self._revive(deaths, self._recovery.resets)
        merged = [fresh.get(index, reply) for index, reply in enumerate(replies)]
        return [reply for reply in merged if reply is not None]

    def _survive_step(self, deaths: RunnersDiedError) -> StepResult:
        """The step's results, with fresh observations in the rows of the dead."""
        replies = self._of_survivors(deaths)
        fresh = self._revive(deaths, self._recovery.steps)
        merged = [fresh.get(index, reply) for index, reply in enumerate(replies)]
        return self.results.step([typed(one, m.StepDone) for one in merged if one is not None])

    def _of_survivors(self, deaths: RunnersDiedError) -> list[m.Message | None]:
        """What the others answered; None where nobody did.

        Raises:
            RemoteEnvError: One of them raised. The next request meets the deaths.
        """
        try:
            for reply in deaths.replies:
                if reply is not None:
                    check(reply)
        except EnvHubError:
            self._answered()
            raise
        return deaths.replies

    def _revive(
        self, deaths: RunnersDiedError, bring_back: Callable[[RunnersDiedError], dict[int, m.M]]
    ) -> dict[int, m.M]:
        """Have the dead shards brought back, and move on to the state that it leads to."""
        self.lifecycle.moved(Event.LOSS)
        self._failures.keep_crash(deaths.first)
        try:
            fresh = bring_back(deaths)
        except WorkerTimeoutError as error:
            if self.closed:
                raise self._failures.dead(error) from error
            self.lifecycle.request = None  # nobody knows how far it came: a reset starts afresh
            self._interruption = None
            self.lifecycle.moved(Event.TIMEOUT)
            raise
        except EnvHubError as error:
            cause = error.__cause__ or deaths.first
            raise self._failures.dead(error) from (None if cause is error else cause)
        except BaseException as error:
            self._interrupted(error)
            self.lifecycle.request = None
            raise
        self.lifecycle.request = None
        self.counters.deaths += len(fresh)
        self.history.revived()
        self.lifecycle.moved(Event.REVIVAL)
        return fresh

    # --- brought back --------------------------------------------------------------------------

    def recover(self) -> None:
        """Before a reset: catch up with a late reply, or give up the jail that owes it.

        A reply that nobody waits for any more, because of Ctrl-C, counts as late. After a death
        a fresh jail is started only if the policy says ``restart="on_reset"``.
        """
        self._note_if_awaited()
        with self._turn("reset"):
            if self._warm:
                self._look_whether_warm_lives()
            self._refuse_others("reset")
            if self.lifecycle.state is State.PENDING:
                self._interruption = self.lifecycle.request
                self.lifecycle.on(Event.INTERRUPT)
            if self.lifecycle.state is State.READY and self.repository.timeouts.idle_s is not None:
                self._see_whether_it_expired()
            if self.lifecycle.state is State.EXPIRED:
                self._forget()
            if self.lifecycle.state is State.LATE:
                self._catch_up()
            if self.lifecycle.state is State.DEAD and self._restarts.permitted:
                self._restarts.spend("reset")
                self._forget()

    def _catch_up(self) -> None:
        lane, request = self.lease.lane, self.lifecycle.request
        try:
            if lane is None or request is None:
                raise WorkerError("an earlier attempt gave the jail up, or nobody knows how far")
            lane.catch_up(Deadline(_GRACE_S))
        except RunnersDiedError:
            pass  # the reset that follows meets them
        except (WorkerDiedError, WorkerTimeoutError) as error:
            error.request = request
            self._failures.keep_crash(error)
            self._forget()
            return
        except EnvHubError:
            self._forget()
            return
        self.lifecycle.request = None
        self.lifecycle.on(Event.REPLY)

    def _see_whether_it_expired(self) -> None:
        try:
            self.lease.look("reset", Deadline(_LOOK_S))
        except WorkerDiedError as error:
            if error.reason == "idle":
                self.lifecycle.moved(Event.EXPIRY)
        # of any other death the reset that follows hears as of its own

    def _forget(self) -> None:
        """Give up the jail; the next request opens another, in the same server."""
        WORKER.info("%s: the jail is given up for a fresh one", self.repository.label)
        self.lease.leave()
        self.lifecycle.request = None
        self.lifecycle.moved(Event.FORGET)

    # --- started -------------------------------------------------------------------------------

    def adopt(self, loaded: LoadedJail) -> None:
        """Use a jail that is already loaded, instead of opening one later."""
        with self._turn("make_env"):
            self.lease.adopt(loaded, Deadline(self.repository.timeouts.startup_s))
            self._started()

    def prewarm(self) -> None:
        """Start its processes in a thread of their own, unless they are there."""
        if self.lifecycle.state is State.IDLE:
            threading.Thread(target=self.warm_up, name="envhub-prewarm", daemon=True).start()

    def warm_up(self) -> None:
        """Start its processes, unless they are there, although nobody has asked for them yet."""
        deadline = StartupDeadline(self.repository.timeouts.startup_s, unasked=True)
        # whatever goes wrong: the first request meets it again, and somebody hears of it there
        with contextlib.suppress(Exception), self._turn("make_env"):
            if self.lifecycle.state is State.IDLE:
                self._warming = deadline
                try:
                    self._start(deadline)
                    self._warm = True
                finally:
                    self._warming = None

    def cool_down(self) -> bool:
        """Give up what was started ahead, if nobody has used it yet; whether it was so."""
        warming = self._warming
        if warming is not None:
            warming.give_up()
        if not self._lock.acquire(timeout=0 if warming is None else _INTERRUPT_S):
            return False  # somebody uses it
        try:
            unused = self._warm and not self.counters.requests
            if not unused or self.lifecycle.state is not State.READY:
                return warming is not None
            with self._turn("make_env"):
                self._warm = False
                self.lifecycle.moved(Event.EXPIRY)  # first: an interrupt must not leave it READY
                self.lease.close_politely()
                self.lease.give_back()
                self.lifecycle.moved(Event.FORGET)
            return True
        finally:
            self._lock.release()

    def on_first_use(self, used: Callable[[], None], make_room: Callable[[], bool]) -> None:
        """Whom to tell that it is used, and whom to ask where a server has no place left."""
        self._first_use, self.lease.make_room = used, make_room

    def _note_first_use(self) -> None:
        if self._first_use is not None:
            tell, self._first_use = self._first_use, None
            tell()

    def _note_if_awaited(self) -> None:
        """Who asks for what is on its way up uses it: the next one need not wait for that."""
        if self._warming is not None:
            self._note_first_use()

    def _look_whether_warm_lives(self) -> None:
        """What was started ahead and has died unused is started again, as if it never had been."""
        self._warm = False
        if self.lifecycle.state is not State.READY:
            return
        try:
            self.lease.look("make_env", Deadline(_LOOK_S))
        except EnvHubError:
            self.lifecycle.moved(Event.EXPIRY)  # as in cool_down
            self._forget()

    def _start(self, deadline: StartupDeadline) -> None:
        try:
            self.lease.acquire(deadline)
        except EnvHubError:
            if self.closed:
                raise closed_during("make_env") from None
            raise
        self._started()

    def _started(self) -> None:
        self.history.started()
        self._recovery.started()
        self.lifecycle.on(Event.START)

    # --- the end -------------------------------------------------------------------------------

    def close(self) -> None:
        """Close the environment and end its processes, in bounded time, from any thread."""
        if self.closed:
            return
        if self.lifecycle.state is State.FOREIGN:
            self.lifecycle.on(Event.CLOSE)
            return
        if not self._lock.acquire(blocking=False):
            self._interrupt()
            return
        try:
            state = self.lifecycle.state
            self._end_life()
            self.lease.note_pace()
            if state is State.READY:
                self.lease.close_politely()
        finally:
            try:
                self.lease.let_go(wait=False)
            finally:
                self._lock.release()

    def _end_life(self) -> None:
        self.lifecycle.moved(Event.CLOSE)
        self._restarts.give_up()

    def _interrupt(self) -> None:
        """Another thread waits for a reply: end the jail under it, then clean up after it.

        If it does not let go in time it cleans up itself, once it sees that this was closed: no
        process is left for it to end.
        """
        if not self.lease.interrupt(self._end_life):
            self.lease.depart()  # who has the turn may be past seeing that it is closed
            return  # whoever brings a jail sees it
        close_s = self.repository.timeouts.close_s
        patience_s = _INTERRUPT_S if close_s is None else min(close_s, _INTERRUPT_S)
        if self._lock.acquire(timeout=patience_s):
            try:
                self.lifecycle.moved(Event.CLOSE)  # the other may have moved at the same moment
                self.lease.let_go()  # of what is there now: it may have moved elsewhere, too
            finally:
                self._lock.release()

    def abandon(self) -> None:
        """In a fork of the process that made it: touch nothing, and refuse from now on."""
        self._lock = threading.RLock()  # whichever thread held it is not here
        self.lifecycle.moved(Event.FORK)
        self.lifecycle.request = None
        self.lease.abandon()


_living: weakref.WeakSet[EnvSession] = weakref.WeakSet()


def _abandon_all() -> None:
    for env in list(_living):
        env.abandon()


os.register_at_fork(after_in_child=_abandon_all)
