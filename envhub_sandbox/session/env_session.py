"""One task's environment: what is asked of it, on which way, and what comes back.

``vector_env`` asks it for replies and knows nothing of jails; ``Lifecycle`` says what is legal.
Sub-environments are spread over shards; every request goes to all of them in one message. Its
life in jails is in ``lease``, what becomes of it when one dies in ``recovery``.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from time import perf_counter_ns
from typing import Any, TypeVar

from envhub_sandbox.errors import (
    EnvHubError,
    RemoteProtocolError,
    WorkerDiedError,
    WorkerError,
    WorkerTimeoutError,
)
from envhub_sandbox.session import lane_requests, survivors
from envhub_sandbox.session.recovery import MessageFor, Mortal
from envhub_sandbox.session.results import StepResult
from envhub_sandbox.transport.deadline import Deadline
from envhub_sandbox.transport.jail import RunnersDiedError, check, typed
from envhub_sandbox.transport.shared_memory.lane import JailGoneError, Outcome
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec.codec import Buffer
from envhub_worker.protocol.lifecycle import Event, State
from envhub_worker.protocol.spaces import batches
from envhub_worker.protocol.untrusted import blamed, is_fault

_GRACE_S = 2.0
"""How long ``reset`` waits for a late reply before it gives the jail up and starts another."""

T = TypeVar("T")
_LANE = 0
"""In place of a request's id, for what went by the fast lane; requests count from 1."""
_BY_LANE = (_LANE, "step")


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
            requests = [
                (runner, message_for(self._number, bounds))
                for runner, bounds in zip(self._runners, self.bounds, strict=True)
            ]
            sent = self._send(operation, requests)
            self._remember(message_for, requests[0][1], sent)
            self.history.requested(message_for)
            self._note_first_use()

    def collect(self, timeout_s: float | None) -> list[m.Message]:
        """The shards' replies to the last ``submit``; the environment is usable afterwards.

        Raises:
            WorkerTimeoutError: The environment is then LATE: ``reset`` brings it back.
            WorkerDiedError: The environment is then DEAD; with ``restart="transparent"`` READY.
            RemoteEnvError: The repository's code raised; the environment is still usable.
        """
        with self._turn("a request"), self._judging():
            deadline = Deadline(timeout_s)
            try:
                replies = self._collect(deadline)
            except RunnersDiedError as deaths:
                replies = self._survive_request(deaths, deadline)
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
        """Send a validated batch of actions, by the fast lane where there is one."""
        with self._lock:
            if self.lifecycle.state is not State.READY:
                with self._turn("step"):
                    self._refuse_unless_usable("step")
                    self._start()
            try:
                if self._lane is None:
                    self._send("step", self._step_requests(actions))
                else:
                    # first: an interrupt from here on leaves a reply that may come
                    self._pending = _BY_LANE
                    self.lifecycle.on(Event.SUBMIT)
                    self._lane.ask(actions)
                    self.counters.lane_steps += 1
            except BaseException:
                with self._turn("step"):
                    raise
            self.history.step(actions)  # while the jail is at it

    def _step_requests(self, actions: Any) -> list[tuple[int, m.Message]]:
        if len(self.bounds) == 1:
            return [(self._runners[0], m.Step(self._number, actions))]
        parts = batches.split(self.manifest.single_action_space, actions, self.bounds)
        return [
            (runner, m.Step(self._number, part))
            for runner, part in zip(self._runners, parts, strict=True)
        ]

    def collect_step(self, timeout_s: float | None) -> StepResult:
        """What ``VectorEnv.step`` returns; raises as ``collect`` does."""
        with self._lock:
            deadline = Deadline(timeout_s)
            try:
                if self._pending is _BY_LANE:
                    return self._collect_by_lane(deadline)
                replies = self._collect(deadline)
                self.counters.stepped(perf_counter_ns() - self._asked_ns)
                for reply in replies:
                    check(reply)
                return self._stepped([typed(reply, m.StepDone) for reply in replies], deadline)
            except RunnersDiedError as deaths:
                with self._turn("step"), self._judging():
                    return self._survive_step(deaths, deadline)
            except BaseException:
                with self._turn("step"), self._judging():
                    raise

    def _collect_by_lane(self, deadline: Deadline) -> StepResult:
        lane = self._lane
        assert lane is not None
        outcomes = self._finish(self._wait_on_lane, deadline)
        self.counters.stepped(lane.elapsed_ns)
        infos: dict[Any, Any] = {}
        if outcomes:
            assert self._place is not None
            fetch = partial(self._fetch_infos, deadline=deadline)
            parts = lane_requests.infos(self._place, outcomes, self.results, fetch)
            try:
                infos = self.results.infos(parts)
            except batches.Misfit:
                infos = self._infos_apart(deadline)
        return (lane.observation(), *lane.flags(), infos)

    def _stepped(self, replies: list[m.StepDone], deadline: Deadline) -> StepResult:
        try:
            return self.results.step(replies)
        except batches.Misfit:
            return self.results.step(replies, self._infos_apart(deadline))

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
        self._send("step", [(runner, m.FetchInfosApart(self._number)) for runner in self._runners])
        try:
            replies = self._collect(deadline)
        except RunnersDiedError as deaths:
            self._pending = None  # the next request meets the deaths
            self._moved(Event.REPLY)
            raise deaths.first from None
        for reply in replies:
            check(reply)
        return self.results.apart([typed(reply, m.Value) for reply in replies])

    def _wait_on_lane(self, deadline: Deadline) -> list[Outcome]:
        assert self._lane is not None
        try:
            return self._lane.wait(deadline)
        except JailGoneError:
            if self._loaded is not None and self._loaded.jail.kept:
                assert self._place is not None
                return survivors.wait(self._place, deadline)
            raise self._cause_of_death() from None

    def _fetch_infos(self, runner: int, deadline: Deadline) -> m.Message:
        self._send("step", [(runner, m.FetchInfos(self._number))])
        try:
            [reply] = self._collect(deadline)
        except RunnersDiedError as deaths:
            asked = [self._runners.index(runner)]
            raise survivors.among_all(deaths, asked, len(self.bounds)) from None
        return reply

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
        loaded, pending = self._loaded, self._pending
        if loaded is None:  # an earlier attempt was interrupted when it had given the jail up
            self._forget()
            return
        deadline = Deadline(_GRACE_S)
        try:
            if pending is None:  # interrupted on the way out: nobody knows what was sent
                raise WorkerTimeoutError("the request was interrupted")
            if pending is _BY_LANE and self._lane is not None:
                self._wait_on_lane(deadline)
            elif pending[0] == _LANE:
                self._receive_by_lane(deadline)
            else:
                loaded.jail.receive(pending[0], deadline)
        except RunnersDiedError:
            pass  # the reset that follows meets them
        except (WorkerDiedError, WorkerTimeoutError) as error:
            if pending is not None:
                error.request = pending[1]
                self._keep_crash(error)
            self._forget()
            return
        except EnvHubError:
            self._forget()
            return
        self._pending = None
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

    def _send(
        self, operation: str, requests: Sequence[tuple[int, m.Message]]
    ) -> list[list[Buffer]]:
        """Send each runner its message; returns the frames of each."""
        assert self._loaded is not None
        self._asked_ns = perf_counter_ns()
        jail = self._loaded.jail
        packed = [(runner, jail.pack(message)) for runner, message in requests]
        messages = [frames for _, frames in packed]
        # what may have to be repeated in a fresh runner goes by the server, who knows the dead
        if self._lane and not self._revives and lane_requests.takes(operation, messages):
            self._tell(operation, messages)
            return messages
        self.lifecycle.on(Event.SUBMIT)  # first, as for a step by the lane
        try:
            request_id = jail.relay(operation, packed)
        except EnvHubError:  # nothing was sent
            self._moved(Event.REPLY)
            raise
        self._pending = (request_id, operation)
        if self._lane and operation == "reset":
            self._lane.observations.leave()
        self.counters.requests += 1
        return messages

    def _tell(self, operation: str, messages: list[list[Buffer]]) -> None:
        assert self._place is not None
        self._pending = (_LANE, operation)  # first, as for a step
        self.lifecycle.on(Event.SUBMIT)
        lane_requests.tell(self._place, operation, messages)
        self.counters.requests += 1

    def _receive_by_lane(self, deadline: Deadline) -> list[m.Message]:
        place, pending = self._place, self._pending
        assert place is not None
        assert pending is not None
        try:
            replies = lane_requests.answers(place, pending[1], deadline)
        except JailGoneError:
            raise self._cause_of_death() from None
        if pending[1] != "reset":
            return replies
        found = (self.manifest, self.bounds, self.results)
        return lane_requests.with_observations(place, replies, *found)

    def _collect(self, deadline: Deadline) -> list[m.Message]:
        loaded, pending = self._loaded, self._pending
        if loaded is None or pending is None:
            state = self.lifecycle.state.value
            raise WorkerError(f"there is no request to wait for: the environment is {state}")
        if pending[0] == _LANE:
            return self._finish(self._receive_by_lane, deadline)
        return self._finish(lambda at: loaded.jail.receive(pending[0], at), deadline)

    def _finish(self, receive: Callable[[Deadline], T], deadline: Deadline) -> T:
        """Wait for the pending reply, and move on to the state that it leads to."""
        assert self._pending is not None
        try:
            received = receive(deadline)
        except WorkerTimeoutError as error:
            self.counters.timeouts += 1
            self._moved(Event.TIMEOUT)
            raise self._late(self._pending[1], deadline) from error
        except RunnersDiedError:
            raise
        except EnvHubError as error:
            if isinstance(error, WorkerDiedError) and error.reason == "idle":
                raise self._expired(self._pending[1], error.detail) from None
            open_still = self.lifecycle.state is not State.CLOSED
            if self._revives and open_still and isinstance(error, WorkerError):
                raise survivors.all_died(error, len(self.bounds)) from error.__cause__
            raise self._dead(error) from error.__cause__
        except BaseException as error:  # Ctrl-C, or whatever else a signal handler raises or does
            if self.lifecycle.state is State.CLOSED and isinstance(error, Exception):
                raise self._dead(WorkerDiedError("")) from error
            self._moved(Event.INTERRUPT)
            raise
        self._pending = None
        self._moved(Event.REPLY)
        return received
