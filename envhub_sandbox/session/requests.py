"""The requests of one environment and their answers: one at a time, and none after ``close``.

The rules and errors for the caller are those of ``gymnasium.vector.AsyncVectorEnv``. ``Lifecycle``
says which requests are legal, the lane sends each request to the shards, and a ``Recovery``, if
there is one, repeats a request that dead shards did not finish.

The lifecycle moves before a message is sent and after its replies are in.
docs/internals/interruption.md gives the reasons; comments name its rules by number.
"""

from __future__ import annotations

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
from envhub_sandbox.session.failures import Failures, Recovery, refusal
from envhub_sandbox.session.lease import AttributeCache, Lease
from envhub_sandbox.session.prewarm import Prewarm
from envhub_sandbox.session.recorder import Recorder
from envhub_sandbox.session.repository import Repository
from envhub_sandbox.session.use_lock import Use, UseLock
from envhub_sandbox.system.log import warn_caller
from envhub_sandbox.transport.deadline import Deadline, StepDeadline, deadline_of
from envhub_sandbox.transport.replies import RunnersDiedError
from envhub_sandbox.transport.results import Results, StepResult, all_replies
from envhub_sandbox.transport.shard_trials import ENOUGH_STEPS
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import Event, State

if TYPE_CHECKING:
    from envhub_sandbox.transport.jail import Request
    from envhub_sandbox.transport.lane import Lane

Bounds = tuple[int, int]
MessageFor = Callable[[int, Bounds], m.Message]
"""Makes the message for a shard, from the environment's number and the shard's bounds."""
OneMessageFor = Callable[[int, "int | None"], m.Message]
"""Makes the message from the number and the sub-environment's index in the shard, or None for a
shard without the sub-environment."""
SENT = "send"
"""The value of ``RequestOrder.waiting`` between ``send`` and ``recv``."""
_SHOWN = 64
"""The most characters of an attribute's name in a request's name."""
T = TypeVar("T")


def for_every_shard(kind: Callable[..., m.Message], *fields: object) -> MessageFor:
    """Returns a function that makes the same message for each shard of an environment."""

    def message_for(number: int, bounds: Bounds) -> m.Message:
        return kind(number, *fields)

    return message_for


class RequestOrder(ABC):
    """Keeps the order of the caller's requests to one environment, in one jail or several.

    Attributes:
        results: Turns replies into what Gymnasium returns.
        closed: Whether the caller has called ``close``.
        waiting: The request whose ``*_async`` was called and whose ``*_wait`` was not, or None.
        face: The name of the environment's class in the error after ``close``.
        attributes: Answers reads of attributes that need no request.
        use: Its lock is held from before a request until its answer is handled; between an
            ``*_async`` and its ``*_wait`` it is free.
        stepping: The id of the thread that is in a step, or None.
        before_request, after_request: Keep the caller's random generators up to date, if set.
    """

    def __init__(
        self,
        repository: Repository,
        results: Results,
        use: Use,
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
        self._unshown = repository.warnings.unshown  # the list itself: a look costs least
        self._timeouts = repository.timeouts
        self._step_deadline = StepDeadline(self._timeouts.step_s)  # one for all steps
        self._warned_of_two = False

    def warn_of_two(self, thread: int) -> None:
        """Warn once if another thread is in a step, because the two mix up their episodes."""
        if self.stepping in (None, thread) or self._warned_of_two:
            return
        self._warned_of_two = True
        warn_caller(
            f"{self._repository.label}: two threads step one environment at the same time. "
            "The second waits for the first, and each continues the other's episodes: give each "
            "thread an environment of its own, or hold a lock around reset and all its steps",
            RuntimeWarning,
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

    def ask_one(self, name: str, index: int, message: OneMessageFor) -> m.Message:
        """Ask one sub-environment; returns its reply, while other shards reply without a value.
        ``index``: ``ITSELF`` asks the repository's own vector environment, which has one shard.
        """
        itself = index == m.ITSELF
        who = "env" if itself else f"envs[{index}]"
        operation = f"{who}.{name[:_SHOWN]}"  # unlike "reset" and "step" of all
        timeouts = {"reset": self._timeouts.reset_s, "step": self._timeouts.step_s}

        def message_for(number: int, bounds: Bounds) -> m.Message:
            start, stop = bounds
            row = index - start if start <= index < stop else None
            return message(number, m.ITSELF if itself else row)

        timeout_s = timeouts.get(name, self._timeouts.call_s)
        replies = self._ask(operation, message_for, (m.Value, m.Method), timeout_s)
        holds = (itself or start <= index < stop for start, stop in self.results.bounds)
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
        """Count a step that was sent; ``actions`` are None if only some workers got actions."""

    @abstractmethod
    def submit(
        self, operation: str, message_for: MessageFor, instead: MessageFor | None = None
    ) -> None:
        """Send a request to every shard, with the lock held."""

    @abstractmethod
    def collect(
        self, timeout: float | Deadline | None, kind: type[m.M] | tuple[type[m.M], ...]
    ) -> list[m.M]:
        """Wait for the shards' replies to the last ``submit``, with the lock held."""

    @abstractmethod
    def one_each(
        self, operation: str, replies: list[m.Value] | list[m.WatchDone]
    ) -> tuple[Any, ...]:
        """One value for each sub-environment, from the shards' replies."""

    def explain(self, error: BaseException) -> None:
        """Prepare for raising an error to the caller: show the repository's warnings first.

        A filter that turns a warning into an error must not hide a Ctrl-C.
        Raises ``ClosedEnvironmentError``: a ``close`` in another thread caused the error.
        """
        with suppress(RemoteEnvWarning):
            self.show_warnings()
        if self.after_request is not None and isinstance(error, RemoteEnvError):
            self.after_request()
        if isinstance(error, WorkerDiedError):
            self.refuse_if_closed()

    def note_answered(self) -> None:
        """Note that a request was answered."""
        if self.after_request is not None:
            self.after_request()

    def show_warnings(self) -> None:
        """Show the repository's new warnings, after all replies are handled.

        A filter of the caller may raise. That must not count as the worker's fault, and it must
        leave no reply owed.
        """
        if self._unshown:
            self._repository.warnings.show(self._repository.label)


class Requests(RequestOrder):
    """Sends the requests to one jail; the first request opens it."""

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
        """Permit only a reset, since other workers were sent a request and this one was not."""
        if self.lifecycle.state is State.READY:
            self.lifecycle.on(Event.SUBMIT)
            self.lifecycle.on(Event.TIMEOUT)  # LATE without a request: a reset takes a new jail

    # --- requests ------------------------------------------------------------------------------

    # The order of a request, which interruption.md explains by rule:
    #
    # 1. ``_sending``: the jail is opened, if there is none, and the message is packed. After a
    #    failure here nothing was sent, and the state is unchanged.
    # 2. ``_outgoing``: the state moves to PENDING, and only then the message is sent. After a
    #    Ctrl-C in between, the next request is refused and ``reset`` waits for a reply.
    # 3. Recovery and recorder note the request, since it was sent.
    # 4. ``_finish``: the replies of all shards are in, and only then the state moves on.
    # 5. ``_incoming``: the replies are decoded and compared with the manifest. A worker that breaks
    #    the protocol in them is given up; no reply is owed any more.
    # 6. The repository's warnings are shown last: a filter of the caller may raise, and must leave
    #    an environment that can be used.

    def submit(
        self, operation: str, message_for: MessageFor, instead: MessageFor | None = None
    ) -> None:
        """Send a request to every shard, with the lock held; opens the jail if there is none.

        If ``instead`` is given, its messages are sent, and those of ``message_for`` only recorded.
        Raises ``LocalProtocolError``: a message cannot be sent, and nothing was sent;
        ``WorkerError``: the environment's state does not permit the request.
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
        """Open the jail if there is none, with the lock held; raises as ``submit`` does.

        ``start``: returns or raises the result of a start that was tried already.
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
        """Send a request to one runner over a lane, with the lock held; raises as ``submit`` does.

        This runner and others may still owe answers to earlier requests.
        """
        ready = self.lifecycle.state is State.READY  # otherwise a request is pending already
        with self._sending(operation), self._outgoing(operation, submit=ready):
            lane.send_some(operation, lane.runners, [lane.jail.pack(message)], ahead=True)

    def _request(self, operation: str, message_for: MessageFor) -> Request:
        lane, bounds = self._lane(), self.results.bounds
        messages = [message_for(lane.number, each) for each in bounds]
        return lane.jail.request(operation, messages, bounds)

    def refuse_whole(self, operation: str, message_for: MessageFor, count: int) -> None:
        """Raise ``LocalProtocolError`` with the position in the caller's whole arguments."""
        lane = self._lane()
        lane.jail.request(operation, [message_for(lane.number, (0, count))], [(0, count)])

    def collect(
        self,
        timeout: float | Deadline | None,
        kind: type[m.M] | tuple[type[m.M], ...],
        lane: Lane | None = None,
    ) -> list[m.M]:
        """Wait for the shards' replies to the last request, with the lock held. After
        ``submit_alone``, wait for the replies on its ``lane``.
        Raises ``WorkerTimeoutError``: the environment is then LATE: ``reset`` brings it back;
        ``WorkerDiedError``: the environment is then DEAD; with ``restart="transparent"`` READY;
        ``RemoteEnvError``: the repository's code raised; the environment is still usable;
        ``ClosedEnvironmentError``: a ``close`` in another thread came first.
        """
        try:
            with self._incoming():
                if self.lifecycle.state is not State.PENDING:
                    raise self._nothing_pending()
                try:
                    replies = self._finish((lane or self._lane()).replies, deadline_of(timeout))
                except RunnersDiedError as deaths:
                    if self._recovery is None:
                        raise self._failures.dead(deaths.first) from None
                    replies = self._recovery.survive_request(deaths)
                answers = all_replies(replies, kind)
                if self._recovery is not None:
                    self._recovery.answered()
        except BaseException as error:
            self.explain(error)
            raise
        self.note_answered()
        self.show_warnings()
        return answers

    def one_each(
        self, operation: str, replies: list[m.Value] | list[m.WatchDone]
    ) -> tuple[Any, ...]:
        """Implements ``RequestOrder.one_each``; gives up a worker with a wrong number of values."""
        with self._incoming():
            return self.results.one_each(operation, replies)

    def finish_reset(self, replies: list[m.ResetDone]) -> tuple[Any, dict[Any, Any]]:
        """Turn replies into the result of ``VectorEnv.reset``; raises as ``collect`` does."""
        with self._incoming():
            return self.results.reset(replies)

    # --- steps ---------------------------------------------------------------------------------

    def submit_step(self, actions: Any, packed: Request | None = None) -> None:
        """Send a validated batch of actions, with the lock held; raises as ``submit`` does.

        ``packed``: the encoded request, if the actions have no layout and were encoded already.
        """
        if self.before_request is not None:
            self.before_request()
        try:
            lifecycle = self.lifecycle
            if lifecycle.state is not State.READY:
                with self.use.hold("step"):
                    self._make_ready("step")
            try:
                lane = self._lease.lane
                assert lane is not None
                lifecycle.request = "step"
                lifecycle.on(Event.SUBMIT)  # interruption.md, rule 1: before anything is sent
                if packed is None:
                    lane.send_step(actions)
                else:
                    lane.send(packed)
            except BaseException as error:
                with self.use.hold("step"):
                    self._nothing_was_sent(error)
                    raise
            self._counters.requests += 1
            self._recorder.step(actions)  # after sending: the jail computes meanwhile
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
        """Wait for a step's results, as ``VectorEnv.step`` returns them; raises as ``collect``."""
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
        if self._counters.steps == ENOUGH_STEPS:  # not only in close(), which may never be called
            self._lease.note_steps()
        return result

    def _mended(self, error: BaseException, deadline: Deadline) -> StepResult:
        """The results of a step whose runners died, from others in their place."""
        if isinstance(error, RunnersDiedError):
            if self._recovery is None:
                raise self._failures.dead(error.first) from None
            return self.results.step(self._recovery.survive_step(error))
        if isinstance(error, RemoteEnvError) and error.__cause__ is not None:
            self.forget_ends(deadline)  # it has a cause here only if infos could not be joined
        raise error

    def forget_ends(self, deadline: Deadline) -> None:
        """After a step whose infos cannot be joined, have the runners forget which episodes ended:
        ``SyncVectorEnv`` does not note them then.
        """
        packed = self.pack("forget_ends", for_every_shard(m.ForgetEnds))
        self.submit_packed("forget_ends", packed)
        self.collect(deadline, m.Value)

    # --- states around sending and receiving -----------------------------------------------------

    @contextmanager
    def _sending(self, operation: str) -> Iterator[None]:
        """Prepare and send a request; an error caused by a ``close`` in another thread says so."""
        try:
            try:
                yield
            except BaseException:
                with self.use.hold(operation):  # only on failure, as it costs microseconds
                    raise
            if self.lifecycle.state is State.CLOSED:
                self._lease.let_go()
        except WorkerDiedError:
            self.refuse_if_closed()
            raise

    @contextmanager
    def _outgoing(self, operation: str, *, submit: bool = True) -> Iterator[None]:
        """Move to PENDING and send a message; ``submit``: whether no other request is pending."""
        if submit:
            self.lifecycle.request = operation
            self.lifecycle.on(Event.SUBMIT)  # interruption.md, rule 1: before anything is sent
        try:
            yield
        except EnvHubError as error:
            if submit:
                self._nothing_was_sent(error)
            raise
        self._counters.requests += 1

    @contextmanager
    def _incoming(self) -> Iterator[None]:
        """Handle replies; a worker that violates the protocol in them is given up."""
        try:
            yield
        except BaseException:
            with self.use.judging("a request"):  # only on failure, as it costs microseconds
                raise
        if self.lifecycle.state is State.CLOSED:
            self._lease.let_go()

    def _make_ready(self, operation: str) -> None:
        state, restart = self.lifecycle.state, self._repository.policy.restart
        # this thread holds the lock, so a request that is still pending was interrupted
        pending = state is State.PENDING
        interrupted = self.lifecycle.request if pending else self._failures.interruption
        refused = refusal(state, operation, restart, interrupted)
        if refused is not None:
            raise refused
        self._prewarm.note_use()  # first, so that the next task starts in parallel
        self._prewarm.start_on_demand()

    def _nothing_was_sent(self, error: BaseException) -> None:
        """Move back from PENDING if the error says that nothing was sent (rule 2)."""
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
        """Wait for the pending reply by ``receive``, and move to the next state; returns it."""
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
        """Move to the state that follows from the error that ended a wait, and raise an error."""
        failures, operation = self._failures, self.lifecycle.request or "a request"
        loaded = self._lease.loaded  # another thread may give it back
        if loaded and isinstance(error, WorkerDiedError) and error.reason == "connection":
            loaded.lost = True
        if isinstance(error, WorkerTimeoutError):
            raise failures.timed_out(operation, deadline) from error
        if isinstance(error, WorkerDiedError) and error.reason == "idle":
            raise failures.expired(operation, error.detail) from None
        if isinstance(error, WorkerError) and self._recovery and not self.lifecycle.closed:
            raise self._recovery.deaths_of_all(error) from error.__cause__
        raise failures.dead(error) from error.__cause__
