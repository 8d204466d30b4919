"""One task's environment: its jail, opened when it is first needed, and its life.

``vector_env`` asks it for replies and knows nothing of jails; ``Lifecycle`` says what is legal.
Sub-environments are spread over shards; every request goes to all of them in one message.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from time import perf_counter_ns
from typing import Any, TypeVar

from envhub_sandbox import lane_requests, survivors
from envhub_sandbox.building import Builder, Place
from envhub_sandbox.deadline import Deadline, StartupDeadline
from envhub_sandbox.errors import (
    EnvHubError,
    WorkerDiedError,
    WorkerError,
    WorkerTimeoutError,
)
from envhub_sandbox.fast_lane import FastLane, JailGoneError, Outcome
from envhub_sandbox.history import History
from envhub_sandbox.jail import HostsDiedError, check, typed
from envhub_sandbox.jail_sources import JailSource, SharedJail
from envhub_sandbox.log import WORKER
from envhub_sandbox.repository import LoadedJail, Repository
from envhub_sandbox.restarts import Restarts
from envhub_sandbox.results import Results, StepResult
from envhub_sandbox.reviving import SeedBook, marked, resets, truncated
from envhub_sandbox.sharding import PaceBook
from envhub_sandbox.stats import LEDGER, Counters, Labels, lane_step_bytes
from envhub_sandbox.survivors import Requests
from envhub_worker.protocol import batches
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.codec import Buffer
from envhub_worker.protocol.lifecycle import Event, Lifecycle, State
from envhub_worker.protocol.manifest import EnvManifest

_GRACE_S = 2.0
"""How long ``reset`` waits for a late reply before it gives the jail up and starts another."""
_INTERRUPT_S = 10.0
"""How long ``close`` waits for another thread to notice that the jail has gone."""

MessageFor = Callable[[int, tuple[int, int]], m.Message]
"""Makes the message for a shard out of the environment's number and the shard's bounds."""

T = TypeVar("T")
D = TypeVar("D")
_CAUSE_S = 10.0
_CAUSE_POLL_S = 0.01
_LANE = 0
"""In place of a request's id, for what went by the fast lane; requests count from 1."""
_BY_LANE = (_LANE, "step")


class RemoteEnv:
    """One vector environment in a jail.

    Safe to use from one thread at a time; ``close`` may come from any thread at any time.

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
        self.manifest = manifest
        self.bounds = list(bounds)
        self._paces = paces
        self.lifecycle = Lifecycle()
        self._jails = jails
        self._lock = threading.RLock()  # a signal handler may close what its own thread waits for
        self._ending = threading.RLock()  # nothing is given back that another thread is ending
        self._owner = os.getpid()
        self._builder = Builder(jails, manifest, self.bounds)
        self._revives = jails.repository.policy.restart == "transparent"
        self._seeds = SeedBook(manifest.num_envs, manifest.shardable)
        self._asked: MessageFor | None = None
        self._place: Place | None = None
        self._loaded: LoadedJail | None = None
        self._hosts: list[int] = []
        self._number = 0
        self._pending: tuple[int, str] | None = None
        self._lane: FastLane | None = None
        self._release_server: Callable[[], None] = _nothing
        self._startup: StartupDeadline | None = None
        self._restarts = Restarts(jails.repository.policy)
        self.counters = Counters(lane_step_bytes(manifest))
        labels = Labels(jails.repository.label, manifest.suite, str(manifest.task))
        LEDGER.add(self, labels, self._restarts)
        self._asked_ns = 0
        self.results = Results(manifest, self.bounds)
        self.history = History(manifest, jails.repository.policy.crash_history)
        _living.add(self)

    @property
    def repository(self) -> Repository:
        """The repository that it comes from."""
        return self._jails.repository

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
        with self._turn(operation):
            self._refuse_unless_usable(operation)
            if self.lifecycle.state is State.IDLE:
                self._start()
            requests = [
                (host, message_for(self._number, bounds))
                for host, bounds in zip(self._hosts, self.bounds, strict=True)
            ]
            self._send(operation, requests)
            self._asked = message_for
            if self._revives and operation == "reset":
                self._seeds.remember(self._reset_of((0, self.manifest.num_envs)))
            self.history.requested(message_for)

    def collect(self, timeout_s: float | None) -> list[m.Message]:
        """The shards' replies to the last ``submit``; the environment is usable afterwards.

        Raises:
            WorkerTimeoutError: The environment is then LATE: ``reset`` brings it back.
            WorkerDiedError: The environment is then DEAD; with ``restart="transparent"`` READY.
            RemoteEnvError: The repository's code raised; the environment is still usable.
        """
        with self._turn("a request"):
            try:
                replies = self._collect(Deadline(timeout_s), timeout_s)
            except HostsDiedError as deaths:
                replies = self._survive_request(deaths)
            for reply in replies:
                check(reply)
            return replies

    def request(
        self, operation: str, message_for: MessageFor, timeout_s: float | None
    ) -> list[m.Message]:
        """``submit`` and ``collect``."""
        self.submit(operation, message_for)
        return self.collect(timeout_s)

    @contextlib.contextmanager
    def _turn(self, operation: str) -> Iterator[None]:
        """Hold the lock. A ``close`` that has come when it is left, did not wait for it."""
        with self._lock, self.repository.named():
            try:
                yield
            except BaseException as error:
                self._after_close(operation, error)
                raise
            if self.lifecycle.state is State.CLOSED:
                self._let_go()

    def _after_close(self, operation: str, error: BaseException) -> None:
        """What failed because of a ``close`` in its midst says so, and gives back what is left.

        Raises:
            WorkerDiedError: It was closed, and the error does not say so.
        """
        if self.lifecycle.state is not State.CLOSED:
            return
        self._let_go()
        if isinstance(error, Exception) and not isinstance(error, WorkerDiedError):
            raise self._closed(operation) from error

    # --- steps ---------------------------------------------------------------------------------

    def submit_step(self, actions: Any) -> None:
        """Send a validated batch of actions, by the fast lane where there is one."""
        with self._lock:
            if self.lifecycle.state is not State.READY:
                with self._turn("step"):
                    self._refuse_unless_usable("step")
                    self._start()
            if self._lane is None:
                with self._turn("step"):
                    self._send("step", self._step_requests(actions))
                self.history.step(actions)
                return
            try:
                # first: an interrupt from here on leaves a reply that may come
                self._pending = _BY_LANE
                self.lifecycle.on(Event.SUBMIT)
                self._lane.ask(actions)
            except BaseException:
                with self._turn("step"):
                    raise
            self.counters.lane_steps += 1
            self.history.step(actions)  # while the jail is at it

    def _step_requests(self, actions: Any) -> list[tuple[int, m.Message]]:
        if len(self.bounds) == 1:
            return [(self._hosts[0], m.Step(self._number, actions))]
        parts = batches.split(self.manifest.single_action_space, actions, self.bounds)
        return [
            (host, m.Step(self._number, part))
            for host, part in zip(self._hosts, parts, strict=True)
        ]

    def collect_step(self, timeout_s: float | None) -> StepResult:
        """What ``VectorEnv.step`` returns; raises as ``collect`` does."""
        with self._lock:
            try:
                if self._pending is _BY_LANE:
                    return self._collect_by_lane(timeout_s)
                replies = self._collect(Deadline(timeout_s), timeout_s)
                self.counters.stepped(perf_counter_ns() - self._asked_ns)
                for reply in replies:
                    check(reply)
                return self.results.step([typed(reply, m.StepDone) for reply in replies])
            except HostsDiedError as deaths:
                with self._turn("step"):
                    return self._survive_step(deaths)
            except BaseException:
                with self._turn("step"):
                    raise

    def _collect_by_lane(self, timeout_s: float | None) -> StepResult:
        lane = self._lane
        assert lane is not None
        outcomes = self._finish(self._wait_on_lane, timeout_s, timeout_s)
        self.counters.stepped(lane.elapsed_ns)
        infos: dict[Any, Any] = {}
        if outcomes:
            assert self._place is not None
            fetch = partial(self._fetch_infos, timeout_s=timeout_s)
            parts = lane_requests.infos(self._place, outcomes, self.results, fetch)
            infos = self.results.lane_infos(parts)
        return (lane.observation(), *lane.flags(), infos)

    def _wait_on_lane(self, timeout_s: float | None) -> list[Outcome]:
        assert self._lane is not None
        try:
            return self._lane.wait(timeout_s)
        except JailGoneError:
            if self._loaded is not None and self._loaded.jail.kept:
                return self._wait_for_survivors(timeout_s)
            raise self._cause_of_death() from None

    def _fetch_infos(self, host: int, timeout_s: float | None) -> m.Message:
        self._send("step", [(host, m.FetchInfos(self._number))])
        try:
            [reply] = self._collect(Deadline(timeout_s), timeout_s)
        except HostsDiedError as deaths:
            asked = [self._hosts.index(host)]
            raise survivors.among_all(deaths, asked, len(self.bounds)) from None
        return reply

    def _cause_of_death(self) -> Exception:
        """Why the jail has ended: the server knows, at the latest when it has reaped it."""
        assert self._loaded is not None
        operation = "step" if self._pending is None else self._pending[1]
        deadline = Deadline(_CAUSE_S)
        while not deadline.passed:
            try:
                self._loaded.jail.output(operation, deadline)
            except EnvHubError as error:
                return error
            time.sleep(_CAUSE_POLL_S)
        return WorkerDiedError(f"the worker process died during {operation}", request=operation)

    def recover(self) -> None:
        """Before a reset: catch up with a late reply, or give up the jail that owes it.

        A reply that nobody waits for any more, because of Ctrl-C, counts as late. After a death
        a fresh jail is started only if the policy says ``restart="on_reset"``.
        """
        with self._turn("reset"):
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

    def _see_whether_it_expired(self) -> None:
        assert self._loaded is not None
        try:
            self._loaded.jail.output("reset", Deadline(_CAUSE_S))
        except WorkerDiedError as error:
            if error.reason == "idle":
                self._moved(Event.EXPIRY)
        # of any other death the reset that follows hears as of its own

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
                self._wait_on_lane(_GRACE_S)
            elif pending[0] == _LANE:
                self._receive_by_lane(_GRACE_S)
            else:
                loaded.jail.receive(pending[0], deadline)
        except HostsDiedError:
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
            raise WorkerDiedError(
                f"cannot {operation}: the worker process has died; make the environment again, or "
                "use policy={'restart': 'on_reset'} and call reset()",
                request=operation,
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

    def _send(self, operation: str, requests: Sequence[tuple[int, m.Message]]) -> None:
        assert self._loaded is not None
        self._asked_ns = perf_counter_ns()
        jail = self._loaded.jail
        packed = [(host, jail.pack(message)) for host, message in requests]
        messages = [frames for _, frames in packed]
        # what may have to be repeated in a fresh host goes by the server, who knows the dead
        if self._lane and not self._revives and lane_requests.takes(operation, messages):
            self._tell(operation, messages)
            return
        request_id = jail.relay(operation, packed)
        if self._lane and operation == "reset":
            self._lane.observations.leave()
        self.counters.requests += 1
        self._pending = (request_id, operation)
        self.lifecycle.on(Event.SUBMIT)

    def _tell(self, operation: str, messages: list[list[Buffer]]) -> None:
        assert self._place is not None
        self._pending = (_LANE, operation)  # first, as for a step
        self.lifecycle.on(Event.SUBMIT)
        lane_requests.tell(self._place, operation, messages)
        self.counters.requests += 1

    def _receive_by_lane(self, timeout_s: float | None) -> list[m.Message]:
        place, pending = self._place, self._pending
        assert place is not None
        assert pending is not None
        try:
            replies = lane_requests.answers(place, pending[1], timeout_s)
        except JailGoneError:
            raise self._cause_of_death() from None
        if pending[1] != "reset":
            return replies
        found = (self.manifest, self.bounds, self.results)
        return lane_requests.with_observations(place, replies, *found)

    def _collect(self, deadline: Deadline, timeout_s: float | None) -> list[m.Message]:
        loaded, pending = self._loaded, self._pending
        if loaded is None or pending is None:
            state = self.lifecycle.state.value
            raise WorkerError(f"there is no request to wait for: the environment is {state}")
        if pending[0] == _LANE:
            return self._finish(self._receive_by_lane, timeout_s, timeout_s)
        return self._finish(lambda at: loaded.jail.receive(pending[0], at), deadline, timeout_s)

    def _finish(self, receive: Callable[[D], T], until: D, timeout_s: float | None) -> T:
        """Wait for the pending reply, and move on to the state that it leads to."""
        assert self._pending is not None
        try:
            received = receive(until)
        except WorkerTimeoutError as error:
            self.counters.timeouts += 1
            self._moved(Event.TIMEOUT)
            raise self._late(self._pending[1], timeout_s) from error
        except HostsDiedError:
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

    def _expired(self, operation: str, why: str) -> WorkerDiedError:
        self._moved(Event.EXPIRY)
        self._pending = None
        text = f"cannot {operation}: {why}, so its processes were ended; call reset() first"
        return WorkerDiedError(text, reason="idle", request=operation, detail=why)

    def _late(self, operation: str, timeout_s: float | None) -> WorkerTimeoutError:
        assert self._loaded is not None
        states = self.repository.states(self._loaded)
        WORKER.info("%s: no answer to %s after %s s", self.repository.label, operation, timeout_s)
        busy = f" (its processes: {', '.join(states)})" if states else ""
        error = WorkerTimeoutError(
            f"{operation} has not finished after {timeout_s} s{busy}; reset() brings the "
            "environment back, in a fresh process if it still does not answer",
            request=operation,
            timeout_s=timeout_s,
        )
        error.worker = states
        return error

    def _dead(self, error: EnvHubError) -> EnvHubError:
        """Write a death down; what closed an environment under its user is told as such."""
        assert self._pending is not None
        if self.lifecycle.state is State.CLOSED:
            return self._closed(self._pending[1])
        self.counters.deaths += 1
        self._moved(Event.DEATH)
        WORKER.info("%s: %s", self.repository.label, str(error).partition("\n")[0])
        kept = self._loaded is not None and self._loaded.jail.kept
        if self._loaded is not None and (kept or not isinstance(error, WorkerDiedError)):
            self._jails.end(self._loaded)  # it lives, and cannot be trusted to do what it says
        if isinstance(error, WorkerDiedError):
            self._keep_crash(error)
        return error

    def _keep_crash(self, error: WorkerDiedError | WorkerTimeoutError) -> None:
        task = {
            "suite": self.manifest.suite,
            "task": self.manifest.task,
            "num_envs": self.manifest.num_envs,
            "shards": len(self.bounds),
            "lane": "frames" if self._lane is None else "shared memory",
        }
        recording, shared = self.history.recording(), isinstance(self._jails, SharedJail)
        self.repository.keep_crash(error, recording, task, self._loaded, shared=shared)

    def _closed(self, operation: str) -> WorkerDiedError:
        text = f"the environment was closed during {operation}"
        return WorkerDiedError(text, reason="killed", request=operation)

    def _moved(self, event: Event) -> None:
        # close() may have come meanwhile, from another thread
        if self.lifecycle.state is not State.CLOSED:
            self.lifecycle.on(event)

    # --- deaths that are survived --------------------------------------------------------------

    def _wait_for_survivors(self, timeout_s: float | None) -> list[Outcome]:
        assert self._place is not None
        assert self._lane is not None
        if timeout_s is not None and self.lifecycle.state is State.PENDING:
            timeout_s = max(0.0, timeout_s - self._lane.waited_s)
        return survivors.wait(self._place, Deadline(timeout_s))

    def _survive_request(self, deaths: HostsDiedError) -> list[m.Message]:
        """A reset is done in fresh hosts; anything else is not repeated.

        Raises:
            WorkerDiedError: It was something else; the next step or reset brings them back.
        """
        replies = self._of_survivors(deaths)
        assert self._pending is not None
        if self._pending[1] != "reset":
            self._pending = None
            self._moved(Event.REPLY)
            raise deaths.first
        for index, reply in self._revive(deaths, self._resets).items():
            done = typed(reply, m.ResetDone)
            replies[index] = replace(done, info=marked(done.info, self._size(index)))
        return [reply for reply in replies if reply is not None]

    def _survive_step(self, deaths: HostsDiedError) -> StepResult:
        """The step's results, with fresh observations in the rows of the dead."""
        started = perf_counter_ns()
        parts = self._of_survivors(deaths)
        for index, reply in self._revive(deaths, self._revivals).items():
            parts[index] = truncated(typed(reply, m.StepDone), self._size(index))
        self.counters.stepped(perf_counter_ns() - started)
        return self.results.step([typed(part, m.StepDone) for part in parts if part is not None])

    def _of_survivors(self, deaths: HostsDiedError) -> list[m.Message | None]:
        """What the others answered; None where nobody did.

        Raises:
            RemoteEnvError: One of them raised. The next request meets the deaths.
        """
        assert self._pending is not None
        try:
            replies = deaths.replies
            if self._lane is not None and self._pending[1] == "step":
                assert self._place is not None
                found = (self.manifest, self.bounds, self.results)
                replies = survivors.answers_by_lane(self._place, deaths, *found)
            for reply in replies:
                if reply is not None:
                    check(reply)
        except EnvHubError:
            self._pending = None
            self._moved(Event.REPLY)
            raise
        return replies

    def _revive(self, deaths: HostsDiedError, requests: Requests) -> dict[int, m.Message]:
        """Bring dead shards back; returns what their fresh hosts answer to the last request."""
        self._moved(Event.LOSS)
        self._keep_crash(deaths.first)
        try:
            replies = self._bring_back(deaths, requests)
        except WorkerTimeoutError as error:
            if self.lifecycle.state is State.CLOSED:
                raise self._dead(error) from error
            self._pending = None  # nobody knows how far it came: a reset starts afresh
            self._moved(Event.TIMEOUT)
            raise
        except EnvHubError as error:
            raise self._dead(error) from (error.__cause__ or deaths.first)
        except BaseException as error:
            if self.lifecycle.state is State.CLOSED and isinstance(error, Exception):
                raise self._dead(WorkerDiedError("")) from error
            self._pending = None
            self._moved(Event.INTERRUPT)
            raise
        self._pending = None
        self.counters.deaths += len(replies)
        self.history.revived()
        self._moved(Event.REVIVAL)
        return replies

    def _bring_back(self, deaths: HostsDiedError, requests: Requests) -> dict[int, m.Message]:
        assert self._pending is not None
        if any(death.reason == "protocol" for death in deaths.deaths.values()):
            raise deaths.first  # whoever breaks the rules is given no second chance
        try:
            self._restarts.spend(self._pending[1])
        except WorkerDiedError as spent:
            raise deaths.first from spent
        dead = sorted(deaths.deaths)
        deadline = self._startup = StartupDeadline(self.repository.timeouts.startup_s)
        try:
            with self.repository.starting():
                self._rebuild(None if deaths.jail_gone else dead, deadline)
        finally:
            self._startup = None
            self._let_server_go()
        return self._ask_anew(dead, requests)

    def _rebuild(self, dead: list[int] | None, deadline: Deadline) -> None:
        """Some shards in fresh hosts of the same jail, or None: all of them in a fresh jail."""
        if dead is None:
            self._leave()
            self._move_into(self._jails.take(deadline), deadline)
        else:
            assert self._place is not None
            self._settle(self._builder.rebuild(self._place, dead, deadline))

    def _ask_anew(self, dead: list[int], requests: Requests) -> dict[int, m.Message]:
        assert self._place is not None
        reset_s = self.repository.timeouts.reset_s
        try:
            return survivors.ask_anew(self._place, dead, requests, Deadline(reset_s))
        except WorkerTimeoutError as error:
            raise self._late("reset", reset_s) from error

    def _revivals(self, index: int) -> list[m.Message]:
        return [m.Revive(self._number, self._derived(index))]

    def _resets(self, index: int) -> list[m.Message]:
        return resets(self._reset_of(self.bounds[index]), self._derived(index))

    def _derived(self, index: int) -> Any:
        return self._seeds.derived(self.bounds[index], self._restarts.count)

    def _reset_of(self, bounds: tuple[int, int]) -> m.Reset:
        assert self._asked is not None
        reset = self._asked(self._number, bounds)
        assert isinstance(reset, m.Reset)
        return reset

    def _size(self, index: int) -> int:
        start, stop = self.bounds[index]
        return stop - start

    # --- the jail ------------------------------------------------------------------------------

    def adopt(self, loaded: LoadedJail) -> None:
        """Use a jail that is already loaded, instead of opening one later."""
        with self._turn("make_env"):
            self._build(loaded, Deadline(self.repository.timeouts.startup_s))

    def _start(self) -> None:
        deadline = self._startup = StartupDeadline(self.repository.timeouts.startup_s)
        try:
            self._build(self._jails.take(deadline), deadline)
        except EnvHubError:
            if self.lifecycle.state is State.CLOSED:
                raise self._closed("make_env") from None
            raise
        finally:
            self._startup = None
            self._let_server_go()

    def _let_server_go(self) -> None:
        release, self._release_server = self._release_server, _nothing
        release()

    def _build(self, loaded: LoadedJail, deadline: Deadline) -> None:
        with self.repository.starting():
            self._build_in(loaded, deadline)

    def _build_in(self, loaded: LoadedJail, deadline: Deadline) -> None:
        self._move_into(loaded, deadline)
        self.history.started()
        self.lifecycle.on(Event.START)

    def _move_into(self, loaded: LoadedJail, deadline: Deadline) -> None:
        try:
            place = self._builder.build(loaded, deadline)
        except BaseException:
            self._jails.give_back(loaded)
            raise
        self._settle(place)
        if self.lifecycle.state is State.CLOSED:  # only now: who closes from here on sees the jail
            raise self._closed("make_env")

    def _settle(self, place: Place) -> None:
        self._place, self._loaded, self._lane = place, place.loaded, place.lane
        self.counters.connected(place.loaded.jail.client)
        self._hosts, self._number = place.hosts, place.number

    def _forget(self) -> None:
        """Give up the jail; the next request opens another, in the same server."""
        WORKER.info("%s: the jail is given up for a fresh one", self.repository.label)
        self._leave()
        self._pending = None
        self._moved(Event.FORGET)

    def _leave(self) -> None:
        self._let_server_go()
        self._release_server = self.repository.hold()
        try:
            if self._loaded is not None:
                self._jails.end(self._loaded)
        finally:
            self._give_back()

    def _give_back(self) -> None:
        with self._ending:
            loaded, self._loaded = self._loaded, None
            try:
                if loaded is not None:
                    self._jails.give_back(loaded)
            finally:
                self._close_lane()

    def close(self) -> None:
        """Close the environment and end its processes, in bounded time, from any thread."""
        if self.lifecycle.state is State.CLOSED:
            return
        if self.lifecycle.state is State.FOREIGN:
            self.lifecycle.on(Event.CLOSE)
            return
        if not self._lock.acquire(blocking=False):
            self._interrupt()
            return
        try:
            state, loaded = self.lifecycle.state, self._loaded
            self._moved(Event.CLOSE)
            self._restarts.give_up()
            self._note_pace()
            if loaded is not None and state is State.READY:
                self._close_politely(loaded)
        finally:
            try:
                self._let_go()
            finally:
                self._lock.release()

    def _let_go(self) -> None:
        """Give back whatever is left of it. A fork of its owner gives back nothing."""
        if os.getpid() != self._owner:
            return
        try:
            self._give_back()
        finally:
            self._let_server_go()

    def abandon(self) -> None:
        """In a fork of the process that made it: touch nothing, and refuse from now on."""
        self._lock = threading.RLock()  # whichever thread held it is not here
        self._ending = threading.RLock()
        if self.lifecycle.state is not State.CLOSED:
            self.lifecycle.on(Event.FORK)
        self._pending, self._release_server = None, _nothing
        self._close_lane()

    def _interrupt(self) -> None:
        """Another thread waits for a reply: end the jail under it, then clean up after it."""
        with self._ending:
            self._moved(Event.CLOSE)
            self._restarts.give_up()
            loaded, startup = self._loaded, self._startup
            if startup is not None:
                startup.give_up()
            if loaded is None:
                return  # whoever brings one sees that it is closed
            self._jails.end(loaded)
        if self._lock.acquire(timeout=_INTERRUPT_S):
            try:
                self._moved(Event.CLOSE)  # the other may have moved at the same moment
                self._let_go()  # of what is there now: it may have moved elsewhere, too
            finally:
                self._lock.release()

    def _note_pace(self) -> None:
        pace = self._lane and self._lane.pace(self.counters.median_step_s())
        if pace:
            self._paces.note(self.manifest, pace)

    def _close_lane(self) -> None:
        lane, self._lane, self._place = self._lane, None, None
        if lane is not None:
            lane.close()

    def _close_politely(self, loaded: LoadedJail) -> None:
        """Let the repository's ``close`` run; whatever it does, the processes end after it."""
        deadline = Deadline(self.repository.timeouts.close_s)
        requests = [(host, m.Close(self._number)) for host in self._hosts]
        with contextlib.suppress(EnvHubError):
            loaded.jail.receive(loaded.jail.send("close", requests), deadline)


_living: weakref.WeakSet[RemoteEnv] = weakref.WeakSet()


def _abandon_all() -> None:
    for env in list(_living):
        env.abandon()


os.register_at_fork(after_in_child=_abandon_all)


def _nothing() -> None:
    """There is nothing to give back."""
