"""The queue of one worker: its requests from ``send``, in order, and their answers.

docs/internals/interruption.md holds for the worker's session. By its rule 1, ``taking`` is set
before an answer is taken, and cleared after the answer is kept and the next request is noted.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import numpy as np
from gymnasium.error import AlreadyPendingCallError

from envhub_sandbox.errors import EnvHubError, RemoteEnvWarning, RemoteProtocolError
from envhub_sandbox.extras.several_workers.part_errors import name_in
from envhub_sandbox.session.env_session import EnvSession
from envhub_sandbox.session.requests import MessageFor
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.lane import Lane
from envhub_sandbox.transport.results import Results, StepResult
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import State
from envhub_worker.protocol.limits import MAX_IN_FLIGHT


class WorkerQueue:
    """The requests that one worker has to answer, and steps that wait to be sent to it.

    If the worker's lane can carry several steps, the next step is sent before the last one is
    answered, which hides the latency of the network. Otherwise the step waits here.

    Args:
        part: The worker's session.
        rows: The first of its sub-environments, and the one after the last.
        sliced: Whether there are other workers, whose infos have to be joined with this one's.

    Attributes:
        count: The number of its sub-environments.
        failure: The error of sending a step, which ``take`` raises.
        taking: Whether an answer is being taken; stays True after an interrupt.
    """

    def __init__(self, part: EnvSession, rows: tuple[int, int], *, sliced: bool) -> None:
        self.part = part
        self.rows = rows
        self.failure: EnvHubError | None = None
        self.count = self.rows[1] - self.rows[0]
        self._requests = part.requests
        self._timeouts = part.repository.timeouts
        self._sliced = sliced
        self._lost = tuple(range(*rows))  # the rows that get no more results after an error
        self._owed: deque[str] = deque()  # operations that were sent, the oldest first
        self._waiting: deque[Any] = deque()  # actions of steps that were not sent yet
        self._deadline = Deadline(None)  # of the oldest request
        self.taking = False

    @property
    def busy(self) -> bool:
        """Whether an answer is owed, or a failure has to be raised."""
        return bool(self._owed or self._waiting) or self.taking or self.failure is not None

    @property
    def interrupted(self) -> bool:
        """Whether an interrupt came while an answer was taken or a message was sent."""
        lane = self.part.lease.lane
        return self.taking or (lane is not None and lane.jail.client.torn)

    @property
    def lane(self) -> Lane | None:
        """The lane to wait on; None if ``take`` has nothing to wait for."""
        return self.part.lease.lane if self._owed else None

    @property
    def left_s(self) -> float | None:
        """The seconds left for its oldest request; None for no limit."""
        return self._deadline.left_s()

    # --- sending ---------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Prepare for ``step``, with the lock held; raises as ``Requests.submit`` does.
        Raises ``AlreadyPendingCallError``: the worker already owes ``MAX_IN_FLIGHT`` answers.
        """
        if len(self._owed) + len(self._waiting) >= MAX_IN_FLIGHT:
            raise AlreadyPendingCallError(
                f"`send` was called {MAX_IN_FLIGHT} times for sub-environment {self.rows[0]} whose "
                "results were not received: call `recv` first",
                "send",
            )
        if not self.busy:
            self._make_ready("step")

    def prepare_reset(self) -> None:
        """Prepare for ``reset``, with the lock held: restart a worker that is dead or late.
        Raises ``AlreadyPendingCallError``: the worker owes an answer.
        """
        if self.busy:
            raise AlreadyPendingCallError(
                f"Calling `send_reset` for sub-environment {self.rows[0]}, whose results were not "
                "received: call `recv` first, or `reset` for all",
                "send",
            )
        self._make_ready("reset")

    def _is_ready(self, operation: str) -> bool:
        """Whether a request can be sent at once; a reset always checks the worker first."""
        return operation != "reset" and self.part.lifecycle.state is State.READY

    def _make_ready(self, operation: str) -> None:
        if self._is_ready(operation):
            return
        with self._naming():
            if operation == "reset":
                self.part.recover()
            self._requests.make_ready(operation)

    def step(self, actions: Any) -> None:
        """Send the worker a step, after ``prepare``. If this fails, ``take`` raises the error."""
        if not self._owed:
            self._try("step", partial(self._requests.submit_step, actions))
        elif not self._waiting and self._requests.takes_more():
            self._try("step", partial(self._requests.submit_ahead, actions))
        else:
            self._waiting.append(copy.deepcopy(actions))  # the caller may reuse its array

    def reset(self, message_for: MessageFor) -> None:
        """Send the worker a reset, after ``prepare_reset``; fails as ``step``."""

        def send() -> None:
            packed = self._requests.pack("reset", message_for)
            self._requests.submit_packed("reset", packed)

        self._try("reset", send)

    def _try(self, operation: str, send: Callable[[], None]) -> None:
        try:
            send()
        except EnvHubError as error:  # nothing was sent
            self.failure = error
            self._waiting.clear()
            return
        self._owed.append(operation)
        if len(self._owed) == 1:
            self._begin()

    def _begin(self) -> None:
        """Start the deadline of the oldest request, at which the worker is now."""
        is_step = self._owed[0] == "step"
        self._deadline = Deadline(self._timeouts.step_s if is_step else self._timeouts.reset_s)

    # --- receiving -------------------------------------------------------------------------------

    def take(self, keep: Callable[[StepResult], None]) -> None:
        """Take the oldest request's results, with the lock held, and pass them to ``keep``.

        Results of a reset have rewards of 0. Raises as ``Requests.collect_step`` and ``collect``
        do; the error names the sub-environments. If the worker is not READY afterwards, nothing is
        owed any more.
        """
        if not self._owed:
            failure, self.failure = self.failure, None
            assert failure is not None
            with self._naming():
                raise failure
        self.taking = True  # interruption.md, rule 1
        try:
            keep(self._take())
        except (EnvHubError, RemoteEnvWarning):
            self._go_on()
            with self._naming():
                raise
        self._go_on()

    @contextmanager
    def _naming(self) -> Iterator[None]:
        """Add to an error the sub-environments that it concerns."""
        try:
            yield
        except EnvHubError as error:
            name_in(self.part, error)
            error.env_ids = self._lost
            raise

    def _take(self) -> StepResult:
        *result, infos = self._collect()
        try:
            infos = self._results().joined(infos)
            if self._sliced and len(result) > 1 and result[1].ndim != 1:
                raise RemoteProtocolError("the worker sent rewards that are not one number each")
        except BaseException:
            with self._requests.use.judging("recv"):  # only on failure, as it costs microseconds
                raise
        if len(result) > 1:
            return (*result, infos)  # of a step
        no = np.zeros(self.count, np.bool_)
        return result[0], np.zeros(self.count), no, no.copy(), infos

    def _results(self) -> Results:
        return self._requests.results

    def _collect(self) -> tuple[Any, ...]:
        """The oldest request's results, as ``VectorEnv.step`` or ``reset`` returns them."""
        if self._owed[0] == "step":
            return self._requests.collect_step(self._deadline)
        replies = self._requests.collect(self._deadline, m.ResetDone)
        return self._requests.finish_reset(replies)

    def _go_on(self) -> None:
        """After an answer, go on to the next request, if the worker is READY."""
        # ``taking`` is cleared last: until then an interrupt finds it set, and ``recv`` refuses.
        self._owed.popleft()
        if self.part.lifecycle.state is not State.READY:
            self.forget()
        elif self._owed:
            self._requests.owe()
            self._begin()
        elif self._waiting:
            self._try("step", partial(self._requests.submit_step, self._waiting.popleft()))
        while self._waiting and self._requests.takes_more():
            self._try("step", partial(self._requests.submit_ahead, self._waiting.popleft()))
        self.taking = False

    def drop(self) -> None:
        """Wait for the answers that are owed, with the lock held, and drop them."""
        self._waiting.clear()
        while self._owed and not self.interrupted:
            with suppress(EnvHubError):  # the reset that follows handles the failure
                self.take(lambda result: None)
        self.forget()

    def forget(self) -> None:
        """Expect nothing more: the session has ended, or will be recovered."""
        self._owed.clear()
        self._waiting.clear()
        self.failure, self.taking = None, False
