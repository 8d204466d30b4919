"""The requests of one environment: one at a time, none after ``close``, and their answers.

The caller's rules and errors are those of ``gymnasium.vector.AsyncVectorEnv``. ``Lifecycle`` says
which requests are legal, the lane takes each to the shards, and a ``Recovery``, if there is one,
repeats what dead shards did not finish.

Where order matters here, docs/internals/interruption.md says why, by the rule's number: the
lifecycle moves before a message goes out and after its replies are in.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError

from envhub_sandbox.errors import (
    EnvHubError,
    LocalProtocolError,
    RemoteEnvError,
    RemoteEnvWarning,
    WorkerDiedError,
    WorkerError,
    WorkerTimeoutError,
)
from envhub_sandbox.session.failures import Failures, refusal
from envhub_sandbox.session.lease import AttributeCache, Lease
from envhub_sandbox.session.prewarm import Prewarm
from envhub_sandbox.session.recorder import Recorder
from envhub_sandbox.session.repository import Repository
from envhub_sandbox.session.use_lock import FleetUse, UseLock
from envhub_sandbox.transport.deadline import Deadline, StepDeadline, deadline_of
from envhub_sandbox.transport.remote_warnings import level_of_the_caller
from envhub_sandbox.transport.replies import RunnersDiedError
from envhub_sandbox.transport.results import Results, StepResult, all_replies
from envhub_sandbox.transport.shard_trials import ENOUGH_STEPS
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import Event, State
from envhub_worker.protocol.spaces import batches

if TYPE_CHECKING:
    from envhub_sandbox.session.recovery import Recovery
    from envhub_sandbox.transport.jail import Request
    from envhub_sandbox.transport.lane import Lane

Bounds = tuple[int, int]
MessageFor = Callable[[int, Bounds], m.Message]
"""Makes the message for a shard out of the environment's number and the shard's bounds."""
OneMessageFor = Callable[[int, "int | None"], m.Message]
"""Makes it of the number and the sub-environment's place in the shard; None in other shards."""
SENT = "send"
"""What is pending between ``send`` and ``recv``, as ``RequestOrder.waiting`` calls it."""
_SHOWN = 64
"""Characters of an attribute's name in the name of a request."""
T = TypeVar("T")


def for_every_shard(kind: Callable[..., m.Message], *fields: object) -> MessageFor:
    """The same message for each shard of an environment, after the environment's number."""

    def message_for(number: int, bounds: Bounds) -> m.Message:
        return kind(number, *fields)

    return message_for


class RequestOrder(ABC):
    """The caller's order of requests to one environment, in one jail or in several.

    Attributes:
        results: Turns replies into what Gymnasium returns.
        closed: Whether the caller has called ``close``.
        waiting: The request of an ``*_async`` whose ``*_wait`` has not come yet.
        face: The name of the environment's class in the error after ``close``.
        attributes: Answers reads of attributes that need no request.
        use: Its lock is held from before a request until its answer is handled; between an
            ``*_async`` and its ``*_wait`` it is free.
        stepping: The thread that is in a step, unless it was interrupted there.
        before_request, after_request: Keep the caller's random generators up to date, if any.
    """

    def __init__(
        self,
        repository: Repository,
        results: Results,
        use: UseLock | FleetUse,
        attributes: AttributeCache,
    ) -> None:
        self.results = results
        self.use = use
        self.attributes = attributes
        self.closed = False
        self.waiting: str | None = None
        self.stepping: int | None = None
        self.face = "SandboxVectorEnv"
        self.before_request: Callable[[], None] | None = None
        self.after_request: Callable[[], None] | None = None
        self._repository = repository
        self._unshown = repository.warnings.unshown
        self._timeouts = repository.timeouts
        self._step_deadline = StepDeadline(self._timeouts.step_s)
        self._warned_of_two = False

    def warn_of_two(self, thread: int) -> None:
        """Warn, once, where another thread is in a step: both get results, of one another's."""
        if self.stepping in (None, thread) or self._warned_of_two:
            return
        self._warned_of_two = True
        warnings.warn(
            f"{self._repository.label}: two threads step one environment at the same time. "
            "The second waits for the first, and each continues the other's episodes: give each "
            "thread an environment of its own, or hold a lock around reset and all its steps",
            RuntimeWarning,
            stacklevel=level_of_the_caller(),
        )

    def refuse_if_busy(self, name: str) -> None:
        """Raise ``AlreadyPendingCallError`` while another request waits for its ``*_wait``."""
        self.refuse_if_closed()
        if self.waiting is not None:
            raise AlreadyPendingCallError(
                f"Calling `{name}` while waiting for a pending call to `{self.waiting}` to "
                "complete.",
                self.waiting,
            )

    def refuse_if_closed(self) -> None:
        """Raise ``ClosedEnvironmentError`` after ``close``."""
        if self.closed:
            cure = (
                "reset opens it again" if self._repository.for_lerobot else "make_env makes another"
            )
            raise ClosedEnvironmentError(
                f"Trying to operate on `{self.face}`, after a call to `close()`. "
                f"{self._repository.label}: {cure}"
            )

    def end_wait(self, operation: str) -> None:
        """Note that ``*_wait`` was called. Raises ``NoAsyncCallError`` without its ``*_async``."""
        self.refuse_if_closed()
        if self.waiting != operation:
            raise NoAsyncCallError(
                f"Calling `{operation}_wait` without any prior call to `{operation}_async`.",
                operation,
            )
        self.waiting = None

    def ask(self, operation: str, message_for: MessageFor) -> list[m.Value]:
        """Send a request, and return the values of all shards."""
        return self._ask(operation, message_for, m.Value, self._timeouts.call_s)

    def ask_own(self, operation: str, kind: Callable[..., m.Message], *fields: object) -> m.Message:
        """Ask the repository's own vector environment, which is in one shard."""
        kinds = (m.Value, m.Method)
        message_for = for_every_shard(kind, *fields)
        [reply] = self._ask(operation, message_for, kinds, self._timeouts.call_s)
        return reply

    def ask_one(self, name: str, index: int, message: OneMessageFor) -> m.Message:
        """Ask one sub-environment; the replies of other shards are empty."""
        operation = f"envs[{index}].{name[:_SHOWN]}"  # which is no reset or step of all
        timeouts = {"reset": self._timeouts.reset_s, "step": self._timeouts.step_s}

        def message_for(number: int, bounds: Bounds) -> m.Message:
            start, stop = bounds
            return message(number, index - start if start <= index < stop else None)

        timeout_s = timeouts.get(name, self._timeouts.call_s)
        replies = self._ask(operation, message_for, (m.Value, m.Method), timeout_s)
        holds = (start <= index < stop for start, stop in self.results.bounds)
        return next(reply for reply, holds_it in zip(replies, holds, strict=True) if holds_it)

    def _ask(
        self,
        operation: str,
        message_for: MessageFor,
        kind: type[m.M] | tuple[type[m.M], ...],
        timeout_s: float | None,
    ) -> list[m.M]:
        with self.use.lock:
            self.refuse_if_busy(operation)
            self.submit(operation, message_for)
            return self.collect(timeout_s, kind)

    def note_sent(self, actions: Any | None) -> None:  # noqa: B027  # for several workers
        """Count a step that was sent; ``actions`` are None where some workers were sent none."""

    @abstractmethod
    def submit(
        self, operation: str, message_for: MessageFor, instead: MessageFor | None = None
    ) -> None:
        """With the lock held, send a request to every shard."""

    @abstractmethod
    def collect(
        self, timeout: float | Deadline | None, kind: type[m.M] | tuple[type[m.M], ...]
    ) -> list[m.M]:
        """With the lock held, the shards' replies to the last ``submit``."""

    @abstractmethod
    def one_each(
        self, operation: str, replies: list[m.Value] | list[m.WatchDone]
    ) -> tuple[Any, ...]:
        """One value for each sub-environment, out of the shards' replies."""

    def explain(self, error: BaseException) -> None:
        """Prepare an error for the caller, and show the repository's warnings first.

        A filter that turns a warning into an error must not hide a Ctrl-C.
        Raises ``ClosedEnvironmentError``: a ``close`` in another thread is the reason.
        """
        with suppress(RemoteEnvWarning):
            self.show_warnings()
        if self.after_request is not None and isinstance(error, RemoteEnvError):
            self.after_request()
        if isinstance(error, WorkerDiedError):
            self.refuse_if_closed()

    def note_answered(self, kind: object = None) -> None:
        """Note that a request was answered, by messages of this ``kind``.

        A reset is only answered after ``finish_reset``, which may ask for its infos again.
        """
        if self.after_request is not None and kind is not m.ResetDone:
            self.after_request()

    def show_warnings(self) -> None:
        """Show the repository's new warnings, after all replies are handled.

        A filter of the caller may raise: that is not the worker's fault, and no reply may be owed.
        """
        if self._unshown:
            self._repository.warnings.show(self._repository.label)


class Requests(RequestOrder):
    """The requests to one jail, which is opened by the first of them."""

    use: UseLock

    def __init__(
        self,
        lease: Lease,
        use: UseLock,
        prewarm: Prewarm,
        recorder: Recorder,
        failures: Failures,
        recovery: Recovery | None,
    ) -> None:
        attributes = AttributeCache([lease], [(0, lease.results.count)])
        super().__init__(lease.repository, lease.results, use, attributes)
        self.lifecycle = lease.lifecycle
        self._lease = lease
        self._prewarm = prewarm
        self._counters = lease.counters
        self._recorder = recorder
        self._failures = failures
        self._recovery = recovery

    def fall_behind(self) -> None:
        """Permit only a reset: this worker was not sent a request that others were sent."""
        if self.lifecycle.state is State.READY:
            self.lifecycle.on(Event.SUBMIT)
            self.lifecycle.on(Event.TIMEOUT)  # with no request to be late: it begins anew

    @property
    def came_back(self) -> bool:
        """Whether processes were restarted during the last request."""
        return self._recovery is not None and bool(self._recovery.fresh)

    # --- requests ------------------------------------------------------------------------------

    # The order of a request, which interruption.md explains by rule:
    #
    # 1. ``_sending``: the jail is opened, if there is none, and the message is packed. What fails
    #    here has sent nothing, and the state is what it was.
    # 2. ``_outgoing``: the state moves to PENDING, and only then the message goes out. After a
    #    Ctrl-C in between, the next request is refused and ``reset`` waits for a reply.
    # 3. Recovery and recorder note it: it is known to have been sent.
    # 4. ``_finish``: the replies of all shards are in, and only then the state moves on.
    # 5. ``_incoming``: the replies are decoded and compared with the manifest. A worker that breaks
    #    a rule in them is given up; no reply is owed any more.
    # 6. The repository's warnings are shown last: a filter of the caller's may raise, and must find
    #    an environment that can be used.

    def submit(
        self, operation: str, message_for: MessageFor, instead: MessageFor | None = None
    ) -> None:
        """With the lock held, send a request to every shard; opens the jail if there is none.

        ``instead`` makes the messages to send; those of ``message_for`` are only recorded then.
        Raises ``LocalProtocolError``: it cannot be sent, and nothing was; ``WorkerError``: the
        environment's state does not permit it.
        """
        if self.before_request is not None:
            self.before_request()
        with self._sending(operation):
            if self.lifecycle.state is not State.READY:
                self._make_ready(operation)
            try:
                request = self.pack(operation, message_for, instead)
            except LocalProtocolError:
                if len(self.results.bounds) > 1:
                    self.refuse_whole(operation, message_for, self.results.manifest.num_envs)
                raise
            self._send_packed(operation, request)
            self._recorder.requested(request)

    def make_ready(self, operation: str, start: Callable[[], object] | None = None) -> None:
        """With the lock held, open the jail if there is none; raises as ``submit`` does.

        ``start`` gives the result of a start that was tried already: it returns, or raises.
        """
        with self._sending(operation):
            if start is not None:
                start()
            elif self.lifecycle.state is not State.READY:
                self._make_ready(operation)

    def pack(
        self, operation: str, message_for: MessageFor, instead: MessageFor | None = None
    ) -> Request:
        """Encode a request without sending it. Raises ``LocalProtocolError``."""
        request = self._request(operation, message_for)
        if instead is not None:
            request.sent = self._request(operation, instead).frames
        return request

    def submit_packed(self, operation: str, request: Request) -> None:
        """Send a packed request; the caller records it. Raises as ``submit`` does."""
        with self._sending(operation):
            self._send_packed(operation, request)

    def _send_packed(self, operation: str, request: Request) -> None:
        with self._outgoing(operation):
            self._lane().send(request)
        if self._recovery is not None:
            self._recovery.sent(request)
        if self._prewarm.first_use is not None:
            self._prewarm.note_use()

    def submit_alone(self, lane: Lane, operation: str, message: m.Message) -> None:
        """With the lock held, send a request over a lane to one runner; raises as ``submit`` does.

        Answers to earlier requests may still be owed, by this runner and by others.
        """
        ready = self.lifecycle.state is State.READY  # otherwise a request is pending already
        with self._sending(operation), self._outgoing(operation, submit=ready):
            lane.send_some(operation, lane.runners, [lane.jail.pack(message)], ahead=True)

    def _request(self, operation: str, message_for: MessageFor) -> Request:
        lane, bounds = self._lane(), self.results.bounds
        messages = [message_for(lane.number, each) for each in bounds]
        return lane.jail.request(operation, messages, bounds)

    def refuse_whole(self, operation: str, message_for: MessageFor, count: int) -> None:
        """Raise ``LocalProtocolError`` with the position in all of the caller's arguments."""
        lane = self._lane()
        lane.jail.request(operation, [message_for(lane.number, (0, count))], [(0, count)])

    def collect(
        self,
        timeout: float | Deadline | None,
        kind: type[m.M] | tuple[type[m.M], ...],
        lane: Lane | None = None,
    ) -> list[m.M]:
        """With the lock held, wait for the shards' replies to the last request; after
        ``submit_alone`` for those that are owed to its ``lane``.
        Raises ``WorkerTimeoutError``: the environment is then LATE: ``reset`` brings it back;
        ``WorkerDiedError``: the environment is then DEAD; with ``restart="transparent"`` READY;
        ``RemoteEnvError``: the repository's code raised; the environment is still usable;
        ``ClosedEnvironmentError``: a ``close`` in another thread came first.
        """
        try:
            with self._incoming():
                replies = self._collect(deadline_of(timeout), kind, lane)
        except BaseException as error:
            self.explain(error)
            raise
        self.note_answered(kind)
        self.show_warnings()
        return replies

    def _collect(
        self, deadline: Deadline, kind: type[m.M] | tuple[type[m.M], ...], lane: Lane | None
    ) -> list[m.M]:
        if self.lifecycle.state is not State.PENDING:
            raise self._nothing_pending()
        try:
            replies = self._finish((lane or self._lane()).replies, deadline)
        except RunnersDiedError as deaths:
            if self._recovery is None:
                raise self._failures.dead(deaths.first) from None
            replies = self._recovery.survive_request(deaths)
        answers = all_replies(replies, kind)
        if self._recovery is not None:
            self._recovery.answered()
        return answers

    def one_each(
        self, operation: str, replies: list[m.Value] | list[m.WatchDone]
    ) -> tuple[Any, ...]:
        """See ``RequestOrder``."""
        with self._incoming():
            return self.results.one_each(operation, replies)

    def finish_reset(
        self, replies: list[m.ResetDone], timeout: float | Deadline | None
    ) -> tuple[Any, dict[Any, Any]]:
        """Turn replies into what ``VectorEnv.reset`` returns; raises as ``collect`` does."""
        with self._incoming():
            try:
                result = self.results.reset(replies)
            except batches.Misfit:
                infos = self._infos_apart(deadline_of(timeout))
                if self._recovery is not None:
                    infos = self._recovery.mark(infos)
                result = self.results.reset(replies, infos)
        self.note_answered()
        return result

    # --- steps ---------------------------------------------------------------------------------

    def submit_step(self, actions: Any, packed: Request | None = None) -> None:
        """Send a validated batch of actions, with the lock held; raises as ``submit`` does.

        ``packed`` is the request, if it was encoded already because the actions have no layout.
        """
        if self.before_request is not None:
            self.before_request()
        try:
            lifecycle = self.lifecycle
            if lifecycle.state is not State.READY:
                with self.use.hold("step"):
                    self._make_ready("step")
            if self._recovery is not None:
                self._recovery.fresh = ()
            try:
                lane = self._lease.lane
                assert lane is not None
                lifecycle.request = "step"
                lifecycle.on(Event.SUBMIT)  # interruption.md, rule 1: first
                if packed is None:
                    lane.send_step(actions)
                else:
                    lane.send(packed)
            except BaseException as error:
                with self.use.hold("step"):
                    self._nothing_was_sent(error)
                    raise
            self._counters.requests += 1
            self._recorder.step(actions)  # while the jail is at it
        except WorkerDiedError:
            self.refuse_if_closed()  # a close() in another thread ended it
            raise

    def takes_more(self) -> bool:
        """Whether ``submit_ahead`` may be called now; asks the lane to permit it next time."""
        if self.lifecycle.state is not State.PENDING:
            return False
        lane = self._lane()
        lane.expect_more()
        return lane.takes_more

    def submit_ahead(self, actions: Any) -> None:
        """Send a step before the last one is answered; raises as ``submit_step`` does.

        After that answer is collected, ``owe`` must be called.
        """
        with self.use.hold("step"):
            self._lane().send_step(actions, ahead=True)
            self._counters.requests += 1
            self._recorder.step(actions)

    def owe(self, operation: str = "step") -> None:
        """After an answer, note that a request that was sent ahead is pending now."""
        self.lifecycle.request = operation
        self.lifecycle.moved(Event.SUBMIT)

    def collect_step(self, timeout: float | Deadline | None) -> StepResult:
        """What ``VectorEnv.step`` returns, with the lock held; raises as ``collect`` does."""
        try:
            deadline: Deadline = self._step_deadline
            if timeout is deadline.timeout_s:
                self._step_deadline.running = False
            else:
                deadline = deadline_of(timeout)
            try:
                lane = self._lease.lane
                if lane is None or self.lifecycle.state is not State.PENDING:
                    raise self._nothing_pending()
                self._finish(lane.wait, deadline)
                self._counters.stepped(lane.elapsed_ns)
                result = lane.result()
            except BaseException as error:
                with self.use.judging("step"):
                    result = self._mended(error, deadline)
        except BaseException as error:
            self.explain(error)
            raise
        if self.after_request is not None:
            self.after_request()
        if self._unshown:
            self.show_warnings()
        if self._counters.steps == ENOUGH_STEPS:  # it may never be closed
            self._lease.note_steps()
        return result

    def _mended(self, error: BaseException, deadline: Deadline) -> StepResult:
        """The results of a step whose infos do not fit together, or whose runners died."""
        if isinstance(error, batches.Misfit):
            return self._lane().result(self._infos_apart(deadline))
        if not isinstance(error, RunnersDiedError):
            raise error
        if self._recovery is None:
            raise self._failures.dead(error.first) from None
        done = self._recovery.survive_step(error)
        try:
            return self.results.step(done)
        except batches.Misfit:
            infos = self._infos_apart(Deadline(self._timeouts.reset_s))
            return self.results.step(done, self._recovery.mark(infos))

    def _infos_apart(self, deadline: Deadline) -> dict[Any, Any]:
        """Fetch the last infos again, one by one, since those of shards do not fit together."""
        own = self.own_infos(deadline)
        try:
            return self.results.joined_own(own)
        except RemoteEnvError:
            self.own_infos(deadline, failed=True)
            raise

    def own_infos(self, deadline: Deadline, *, failed: bool = False) -> list[m.Value]:
        """Fetch the last infos of each sub-environment as it gave them, by shards.

        ``failed`` tells the runners instead that these could not be joined.
        """
        lane = self._lane()
        with self._outgoing("step"):
            lane.send_for_infos(failed=failed)
        try:
            replies = self._finish(lane.replies, deadline)
        except RunnersDiedError as deaths:
            self.lifecycle.answered()  # the next request meets the deaths
            raise deaths.first from None
        return all_replies(replies, m.Value)

    def checked_own_infos(self, deadline: Deadline, *, failed: bool = False) -> list[m.Value]:
        """``own_infos`` of one worker of several, which is given up if it sends infos of others."""
        with self.use.judging("a request"):
            replies = self.own_infos(deadline, failed=failed)
            self.results.own_pairs(replies)
            return replies

    # --- states around sending and receiving -----------------------------------------------------

    @contextmanager
    def _sending(self, operation: str) -> Iterator[None]:
        """Prepare and send a request: an error caused by a ``close`` in another thread says so."""
        try:
            try:
                yield
            except BaseException:
                with self.use.hold(operation):  # on failure only: it costs some us
                    raise
            if self.lifecycle.state is State.CLOSED:
                self._lease.let_go()
        except WorkerDiedError:
            self.refuse_if_closed()
            raise

    @contextmanager
    def _outgoing(self, operation: str, *, submit: bool = True) -> Iterator[None]:
        """Send a message; ``submit`` unless another request is pending."""
        if submit:
            self.lifecycle.request = operation
            self.lifecycle.on(Event.SUBMIT)  # interruption.md, rule 1: first
        try:
            yield
        except EnvHubError as error:
            if submit:
                self._nothing_was_sent(error)
            raise
        self._counters.requests += 1

    @contextmanager
    def _incoming(self) -> Iterator[None]:
        """Handle replies: a worker that breaks a rule in them is given up."""
        try:
            yield
        except BaseException:
            with self.use.judging("a request"):  # on failure only: it costs some us
                raise
        if self.lifecycle.state is State.CLOSED:
            self._lease.let_go()

    def _make_ready(self, operation: str) -> None:
        state, restart = self.lifecycle.state, self._repository.policy.restart
        # a request that is still pending here was interrupted before its wait began
        pending = state is State.PENDING
        interrupted = self.lifecycle.request if pending else self._failures.interruption
        refused = refusal(state, operation, restart, interrupted)
        if refused is not None:
            raise refused
        self._prewarm.note_use()  # already: the next one starts beside this
        self._prewarm.start_on_demand()

    def _nothing_was_sent(self, error: BaseException) -> None:
        """Restore the state if nothing was sent: interruption.md, rule 2."""
        if isinstance(error, EnvHubError) and self.lifecycle.state is State.PENDING:
            self.lifecycle.answered()

    def _lane(self) -> Lane:
        lane = self._lease.lane
        assert lane is not None
        return lane

    def _nothing_pending(self) -> WorkerError:
        state = self.lifecycle.state.value
        return WorkerError(f"there is no request to wait for: the environment is {state}")

    def _finish(self, receive: Callable[[Deadline], T], deadline: Deadline) -> T:
        """Wait for the pending reply, and move to the state that follows."""
        try:
            received = receive(deadline)
        except RunnersDiedError:
            raise
        except EnvHubError as error:
            self._lease.forget_watched()
            self._failed(error, deadline)
        except BaseException as error:  # interruption.md, rules 2 and 3: a Ctrl-C, for instance
            self._lease.forget_watched()
            self._failures.interrupted(error)
            raise
        self.lifecycle.answered()
        return received

    def _failed(self, error: EnvHubError, deadline: Deadline) -> NoReturn:
        """Raise the error that ended a wait, and move to the state that follows."""
        failures, operation = self._failures, self.lifecycle.request or "a request"
        if isinstance(error, WorkerDiedError) and error.reason == "connection":
            self._lease.note_lost()
        if isinstance(error, WorkerTimeoutError):
            raise failures.timed_out(operation, deadline) from error
        if isinstance(error, WorkerDiedError) and error.reason == "idle":
            raise failures.expired(operation, error.detail) from None
        if isinstance(error, WorkerError) and self._recovery and not self.lifecycle.closed:
            raise self._recovery.deaths_of_all(error) from error.__cause__
        raise failures.dead(error) from error.__cause__
