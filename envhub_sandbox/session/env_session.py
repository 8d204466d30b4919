"""One task's environment: what is asked of it, on which way, and what comes back.

``vector_env`` asks it for replies and knows nothing of jails; ``Lifecycle`` says what is legal.
Sub-environments are spread over shards; every request goes to all of them in one message. Its
life in jails is in ``lease``, what becomes of it when one dies in ``recovery``.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar

from envhub_sandbox.errors import (
    EnvHubError,
    LocalProtocolError,
    RemoteProtocolError,
    WorkerDiedError,
    WorkerError,
    WorkerTimeoutError,
)
from envhub_sandbox.session import survivors
from envhub_sandbox.session.recovery import MessageFor, Mortal
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.jail import RunnersDiedError, check, typed
from envhub_sandbox.transport.lane import Lane
from envhub_sandbox.transport.results import StepResult
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import Event, State
from envhub_worker.protocol.spaces import batches
from envhub_worker.protocol.untrusted import blamed, is_fault

_GRACE_S = 2.0
"""How long ``reset`` waits for a late reply before it gives the jail up and starts another."""

T = TypeVar("T")


class RemoteEnv(Mortal):
    """One vector environment in a jail. It is made of what a ``Tenant`` is made of.

    Safe to use from one thread at a time; ``close`` may come from any thread at any time.
    """

    # --- requests ------------------------------------------------------------------------------

    def submit(self, operation: str, message_for: MessageFor) -> None:
        """Send a request to every shard, opening the jail if there is none.

        Raises:
            LocalProtocolError: It cannot be sent; nothing was.
            WorkerError: The environment is not in a state to take it.
        """
        with self._turn(operation):
            self._refuse_unless_usable(operation)
            if self.lifecycle.state is State.IDLE:
                self._start()
            lane = self._lane
            assert lane is not None
            messages = [message_for(lane.number, bounds) for bounds in self.bounds]
            try:
                packed = lane.pack(messages)
            except LocalProtocolError:
                self._refuse_whole(lane, message_for)
                raise
            self._send(operation, partial(lane.send, operation, packed))
            self._remember(message_for, messages[0], packed)
            self.history.requested(message_for)
            self._note_first_use()

    def _refuse_whole(self, lane: Lane, message_for: MessageFor) -> None:
        """Raise what cannot be sent as it is called in the caller's arguments, not in a shard's."""
        if len(self.bounds) > 1:
            lane.pack([message_for(lane.number, (0, self.manifest.num_envs))])

    def collect(self, timeout_s: float | None) -> list[m.Message]:
        """The shards' replies to the last ``submit``; the environment is usable afterwards.

        Raises:
            WorkerTimeoutError: The environment is then LATE: ``reset`` brings it back.
            WorkerDiedError: The environment is then DEAD; with ``restart="transparent"`` READY.
            RemoteEnvError: The repository's code raised; the environment is still usable.
        """
        with self._turn("a request"), self._judging():
            try:
                replies = self._finish(self._asked_lane().replies, Deadline(timeout_s))
            except RunnersDiedError as deaths:
                replies = self._survive_request(deaths)
            for reply in replies:
                check(reply)
            self._has_set()
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
                self._distrust(broken)
                raise broken from error
            if isinstance(error, RemoteProtocolError):
                self._distrust(error)
            raise

    # --- steps ---------------------------------------------------------------------------------

    def submit_step(self, actions: Any) -> None:
        """Send a validated batch of actions."""
        with self._lock:
            if self.lifecycle.state is not State.READY:
                with self._turn("step"):
                    self._refuse_unless_usable("step")
                    self._start()
            try:
                lane = self._lane
                assert lane is not None
                self.lifecycle.request = "step"
                # first: an interrupt from here on leaves a reply that may come
                self.lifecycle.on(Event.SUBMIT)
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
            deadline = Deadline(timeout_s)
            try:
                lane = self._asked_lane()
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

    def finish_reset(
        self, replies: list[m.ResetDone], timeout_s: float | None
    ) -> tuple[Any, dict[Any, Any]]:
        """What ``VectorEnv.reset`` returns, of the replies to one; raises as ``collect`` does."""
        with self.handling():
            try:
                return self.results.reset(replies)
            except batches.Misfit:
                return self.results.reset(replies, self._infos_apart(Deadline(timeout_s)))

    def _infos_apart(self, deadline: Deadline) -> dict[Any, Any]:
        """The last infos, of shards that do not agree about them."""
        lane = self._lane
        assert lane is not None
        self._send("step", lane.send_for_infos)
        try:
            replies = self._finish(lane.replies, deadline)
        except RunnersDiedError as deaths:
            self.lifecycle.request = None  # the next request meets the deaths
            self._moved(Event.REPLY)
            raise deaths.first from None
        for reply in replies:
            check(reply)
        return self.results.apart([typed(reply, m.Value) for reply in replies])

    def recover(self) -> None:
        """Before a reset: catch up with a late reply, or give up the jail that owes it.

        A reply that nobody waits for any more, because of Ctrl-C, counts as late. After a death
        a fresh jail is started only if the policy says ``restart="on_reset"``.
        """
        with self._turn("reset"):
            if self._warm:
                self._look_whether_warm_lives()
            if self.lifecycle.state is State.PENDING:
                self.lifecycle.on(Event.INTERRUPT)
            if self.lifecycle.state is State.READY and self.repository.timeouts.idle_s is not None:
                self._see_whether_it_expired()
            if self.lifecycle.state is State.EXPIRED:
                self._forget()
            if self.lifecycle.state is State.LATE:
                self._catch_up()
            may_restart = self.repository.policy.restart != "never"
            if self.lifecycle.state is State.DEAD and may_restart:
                self._restarts.spend("reset")
                self._forget()

    def _catch_up(self) -> None:
        lane, request = self._lane, self.lifecycle.request
        try:
            if lane is None or request is None:
                raise WorkerError("an earlier attempt gave the jail up, or nobody knows how far")
            lane.catch_up(Deadline(_GRACE_S))
        except RunnersDiedError:
            pass  # the reset that follows meets them
        except (WorkerDiedError, WorkerTimeoutError) as error:
            error.request = request
            self._keep_crash(error)
            self._forget()
            return
        except EnvHubError:
            self._forget()
            return
        self.lifecycle.request = None
        self.lifecycle.on(Event.REPLY)

    def _refuse_unless_usable(self, operation: str) -> None:
        state = self.lifecycle.state
        if state in (State.LATE, State.PENDING):
            raise WorkerTimeoutError(
                f"cannot {operation}: the reply to the last request is late; call reset() first",
                request=operation,
            )
        if state is State.DEAD:
            advice = "call reset() first"
            if self.repository.policy.restart == "never":
                advice = (
                    "make the environment again, or use policy={'restart': 'on_reset'} and call "
                    "reset()"
                )
            raise WorkerDiedError(
                f"cannot {operation}: the worker process has died; {advice}", request=operation
            )
        if state is State.EXPIRED:
            raise self._expired(operation, "it was idle for too long")
        if state is State.FOREIGN:
            raise WorkerError(
                f"cannot {operation}: this environment belongs to another process, and this is a "
                f"fork of it ({os.getpid()}); call make_env here to get one of its own"
            )
        if state is State.CLOSED:
            raise self._closed(operation)
        if state not in (State.IDLE, State.READY):
            raise WorkerError(f"cannot {operation}: the environment is {state.value}")

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
            self.lifecycle.request = None
            self.lifecycle.on(Event.REPLY)

    def _asked_lane(self) -> Lane:
        lane = self._lane
        if lane is None or self.lifecycle.state is not State.PENDING:
            state = self.lifecycle.state.value
            raise WorkerError(f"there is no request to wait for: the environment is {state}")
        return lane

    def _finish(self, receive: Callable[[Deadline], T], deadline: Deadline) -> T:
        """Wait for the pending reply, and move on to the state that it leads to."""
        request = self.lifecycle.request
        assert request is not None
        try:
            received = receive(deadline)
        except WorkerTimeoutError as error:
            self.counters.timeouts += 1
            self._moved(Event.TIMEOUT)
            raise self._late(request, deadline) from error
        except RunnersDiedError:
            raise
        except EnvHubError as error:
            if isinstance(error, WorkerDiedError) and error.reason == "idle":
                raise self._expired(request, error.detail) from None
            open_still = self.lifecycle.state is not State.CLOSED
            if self._revives and open_still and isinstance(error, WorkerError):
                raise survivors.all_died(error, len(self.bounds)) from error.__cause__
            raise self._dead(error) from error.__cause__
        except BaseException as error:  # Ctrl-C, or whatever else a signal handler raises or does
            if self.lifecycle.state is State.CLOSED and isinstance(error, Exception):
                raise self._dead(WorkerDiedError("")) from error
            self._moved(Event.INTERRUPT)
            raise
        self.lifecycle.request = None
        self._moved(Event.REPLY)
        return received
