"""What is asked of an environment, and what comes back: one request at a time, and its answers.

``Lifecycle`` says what is legal. The lane takes each request to the shards, and a ``Recovery``
stands in for those that die of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn, TypeVar

from envhub_sandbox.crash.history import History
from envhub_sandbox.errors import (
    EnvHubError,
    LocalProtocolError,
    WorkerDiedError,
    WorkerError,
    WorkerTimeoutError,
)
from envhub_sandbox.session.attributes import Attributes
from envhub_sandbox.session.counters import Counters
from envhub_sandbox.session.head_start import HeadStart
from envhub_sandbox.session.lease import Lease
from envhub_sandbox.session.refusals import refusal
from envhub_sandbox.session.survival.failures import Failures
from envhub_sandbox.session.survival.recovery import Recovery
from envhub_sandbox.session.survival.revived_rows import marked
from envhub_sandbox.session.turns import Turns, collision
from envhub_sandbox.transport.deadline import Deadline, StepDeadline
from envhub_sandbox.transport.jail import RunnersDiedError
from envhub_sandbox.transport.lane import Lane
from envhub_sandbox.transport.replies import check, typed
from envhub_sandbox.transport.request import Request
from envhub_sandbox.transport.results import Results, StepResult
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import Event, State
from envhub_worker.protocol.spaces import batches

MessageFor = Callable[[int, tuple[int, int]], m.Message]
"""Makes the message for a shard out of the environment's number and the shard's bounds."""
T = TypeVar("T")


class Exchange:
    """The requests of one environment, whose jail is opened by the first of them.

    Args:
        lease: Its jail, and the lane there.
        turns: Whose turn it is.
        head_start: Starts it, and is told that it is used.
        results: What it is expected to be, and its slices.
        counters: Of requests, steps and what went wrong.
        history: Of what was asked.
        failures: Make the errors.
        recovery: Stands in for those that die.

    Attributes:
        results: Makes of replies what Gymnasium returns.
        attributes: What need not be asked for.
    """

    def __init__(
        self,
        lease: Lease,
        turns: Turns,
        head_start: HeadStart,
        results: Results,
        counters: Counters,
        history: History,
        failures: Failures,
        recovery: Recovery,
    ) -> None:
        self.results = results
        self.attributes = Attributes(lease, counters)
        self.lifecycle = lease.lifecycle
        self._lease = lease
        self._turns = turns
        self._head_start = head_start
        self._counters = counters
        self._history = history
        self._failures = failures
        self._recovery = recovery
        self._interruption: str | None = None  # the request that is late for that reason
        self._fresh: tuple[int, ...] = ()  # shards that came back in the last request
        self._step_deadline = StepDeadline(lease.repository.timeouts.step_s)

    # --- requests ------------------------------------------------------------------------------

    def submit(
        self, operation: str, message_for: MessageFor, instead: MessageFor | None = None
    ) -> None:
        """Send a request to every shard, opening the jail if there is none.

        Args:
            operation: What it is called.
            message_for: Makes what is asked, as it is remembered.
            instead: Makes what is sent in its place, if the answer is to say more.

        Raises:
            LocalProtocolError: It cannot be sent; nothing was.
            WorkerError: The environment is not in a state to take it.
        """
        with self._turns.lock:
            try:
                self._submit(operation, message_for, instead)
            except BaseException:
                with self._turns.take(operation):  # only now: what goes well has no need of it
                    raise
            if self.lifecycle.state is State.CLOSED:
                self._lease.let_go()

    def _submit(self, operation: str, message_for: MessageFor, instead: MessageFor | None) -> None:
        self._make_ready(operation)
        lane = self._lane()
        try:
            request = self._request(lane, operation, message_for)
            sent = request if instead is None else self._request(lane, operation, instead)
        except LocalProtocolError:
            self._refuse_whole(operation, message_for)
            raise
        self._send(operation, lambda: lane.send(sent))
        self._recovery.sent(request)
        self._history.requested(request)
        self._head_start.note_use()

    def _request(self, lane: Lane, operation: str, message_for: MessageFor) -> Request:
        bounds = self.results.bounds
        return lane.request(operation, [message_for(lane.number, each) for each in bounds])

    def _refuse_whole(self, operation: str, message_for: MessageFor) -> None:
        """Raise what cannot be sent as it is called in the caller's arguments, not in a shard's."""
        if len(self.results.bounds) > 1:
            lane = self._lane()
            lane.request(operation, [message_for(lane.number, (0, self.results.manifest.num_envs))])

    def collect(self, timeout_s: float | None) -> list[m.Message]:
        """The shards' replies to the last ``submit``; the environment is usable afterwards.

        Raises:
            WorkerTimeoutError: The environment is then LATE: ``reset`` brings it back.
            WorkerDiedError: The environment is then DEAD; with ``restart="transparent"`` READY.
            RemoteEnvError: The repository's code raised; the environment is still usable.
        """
        with self._turns.lock:
            try:
                replies = self._collect(timeout_s)
            except BaseException:
                with self._turns.judging("a request"):
                    raise
            if self.lifecycle.state is State.CLOSED:
                self._lease.let_go()
            return replies

    def _collect(self, timeout_s: float | None) -> list[m.Message]:
        self._fresh = ()
        try:
            lane = self._lease.lane
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
        with self._turns.judging("a request"):
            yield

    def finish_reset(
        self, replies: list[m.ResetDone], timeout_s: float | None
    ) -> tuple[Any, dict[Any, Any]]:
        """What ``VectorEnv.reset`` returns, of the replies to one; raises as ``collect`` does."""
        with self.handling():
            try:
                return self.results.reset(replies)
            except batches.Misfit:
                infos, fresh = self._infos_apart(Deadline(timeout_s)), self._fresh
                return self.results.reset(replies, self._marked(infos, fresh) if fresh else infos)

    # --- steps ---------------------------------------------------------------------------------

    def submit_step(self, actions: Any) -> None:
        """Send a validated batch of actions."""
        with self._turns.lock:
            lifecycle = self.lifecycle
            if lifecycle.state is not State.READY:
                with self._turns.take("step"):
                    self._make_ready("step")
            try:
                lane = self._lease.lane
                assert lane is not None
                lifecycle.request = "step"
                # first: an interrupt from here on leaves a reply that may come
                lifecycle.on(Event.SUBMIT)
                lane.send_step(actions)
            except BaseException as error:
                with self._turns.take("step"):
                    self._nothing_was_sent(error)
                    raise
            self._counters.requests += 1
            self._history.step(actions)  # while the jail is at it

    def collect_step(self, timeout_s: float | None) -> StepResult:
        """What ``VectorEnv.step`` returns; raises as ``collect`` does."""
        with self._turns.lock:
            deadline: Deadline = self._step_deadline
            if timeout_s is self._step_deadline.timeout_s:
                self._step_deadline.again()
            else:
                deadline = Deadline(timeout_s)
            try:
                lane = self._lease.lane
                if lane is None or self.lifecycle.state is not State.PENDING:
                    raise self._nothing_asked()
                self._finish(lane.wait, deadline)
                self._counters.stepped(lane.elapsed_ns)
                try:
                    return lane.result()
                except batches.Misfit:
                    return lane.result(self._infos_apart(deadline))
            except RunnersDiedError as deaths:
                with self._turns.judging("step"):
                    return self._survive_step(deaths)
            except BaseException:
                with self._turns.judging("step"):
                    raise

    # --- out and back --------------------------------------------------------------------------

    def _make_ready(self, operation: str) -> None:
        if self.lifecycle.state is State.READY:
            return
        state, restart = self.lifecycle.state, self._lease.repository.policy.restart
        # a request that is still pending here was interrupted before anybody waited
        interrupted = self.lifecycle.request if state is State.PENDING else self._interruption
        refused = refusal(state, operation, restart, interrupted)
        if refused is not None:
            self.refuse_others(operation)
            raise refused
        self._head_start.note_use()  # already: the next is started beside this
        self._head_start.start()

    def refuse_others(self, operation: str) -> None:
        """A request that another thread waits for is not late: it is in use.

        Raises:
            AlreadyPendingCallError: It is.
        """
        if self.lifecycle.state is State.PENDING:
            found = collision(self, operation)
            if found is not None:
                raise found

    def note_interruption(self) -> None:
        """What was asked is waited for by nobody any more: its reply is late."""
        self._interruption = self.lifecycle.request
        self.lifecycle.on(Event.INTERRUPT)

    def _send(self, operation: str, send: Callable[[], None]) -> None:
        self.lifecycle.request = operation
        self.lifecycle.on(Event.SUBMIT)  # first, as for a step
        try:
            send()
        except EnvHubError as error:
            self._nothing_was_sent(error)
            raise
        self._counters.requests += 1

    def _nothing_was_sent(self, error: BaseException) -> None:
        """Go back to where we were, if the lane says so: by an error of this project."""
        if isinstance(error, EnvHubError) and self.lifecycle.state is State.PENDING:
            self._answered()

    def _answered(self) -> None:
        """Nothing is owed any more."""
        self.lifecycle.request = None
        self.lifecycle.moved(Event.REPLY)

    def _lane(self) -> Lane:
        lane = self._lease.lane
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
            self._lease.forget_watched()
            self._failed(error, deadline)
        except BaseException as error:  # Ctrl-C, or whatever else a signal handler raises or does
            self._lease.forget_watched()
            self._interrupted(error)
            raise
        lifecycle.request = None
        lifecycle.moved(Event.REPLY)
        return received

    def _failed(self, error: EnvHubError, deadline: Deadline) -> NoReturn:
        """Tell of a wait that ended in an error, and move on to the state that it leads to."""
        failures, operation = self._failures, self.lifecycle.request or "a request"
        if isinstance(error, WorkerTimeoutError):
            self._counters.timeouts += 1
            self._interruption = None
            self.lifecycle.moved(Event.TIMEOUT)
            raise failures.late(operation, deadline) from error
        if isinstance(error, WorkerDiedError) and error.reason == "idle":
            raise failures.expired(operation, error.detail) from None
        if isinstance(error, WorkerError) and not self.lifecycle.closed:
            deaths = self._recovery.survivable(error)
            if deaths is not None:
                raise deaths from error.__cause__
        raise failures.dead(error) from error.__cause__

    def _interrupted(self, error: BaseException) -> None:
        """Nobody waits any more, but something may come.

        Raises:
            WorkerDiedError: It was a ``close`` in the midst, which took away what was waited on.
        """
        if self.lifecycle.closed and isinstance(error, Exception):
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
        self._fresh = tuple(fresh)
        return [reply for reply in merged if reply is not None]

    def _survive_step(self, deaths: RunnersDiedError) -> StepResult:
        """The step's results, with fresh observations in the rows of the dead."""
        replies = self._of_survivors(deaths)
        fresh = self._revive(deaths, self._recovery.steps)
        merged = [fresh.get(index, reply) for index, reply in enumerate(replies)]
        done = [typed(one, m.StepDone) for one in merged if one is not None]
        try:
            return self.results.step(done)
        except batches.Misfit:
            infos = self._infos_apart(Deadline(self._lease.repository.timeouts.reset_s))
            return self.results.step(done, self._marked(infos, fresh))

    def _marked(self, infos: dict[Any, Any], fresh: Iterable[int]) -> dict[Any, Any]:
        """All infos, of which those of the fresh shards say so, as they do when they fit."""
        bounds = [self.results.bounds[index] for index in fresh]
        return marked(infos, self.results.manifest.num_envs, bounds)

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
            if self.lifecycle.closed:
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
        self._counters.deaths += len(fresh)
        self._history.revived()
        self.lifecycle.moved(Event.REVIVAL)
        return fresh
