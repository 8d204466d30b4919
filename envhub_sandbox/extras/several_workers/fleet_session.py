"""The life and the requests of one environment over several workers.

A *part* is an ``EnvSession`` with some of the sub-environments, in a jail of its own, which its
launcher may open on any server. Each part has its own restarts, counters and end. The classes here
have the interface of ``EnvSession`` for a ``SandboxVectorEnv``, and pass each request to all parts.

A request goes to all parts before the wait for the first answer. Every part is waited for, even if
another part has failed, so no part owes an answer afterwards. docs/internals/interruption.md holds
for each part. A Ctrl-C between parts leaves some of them ``READY`` and some ``PENDING``: the next
request is refused, and ``reset`` takes the late answers.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain
from time import perf_counter_ns
from typing import Any, TypeVar

from envhub_sandbox.errors import (
    LocalProtocolError,
    RemoteEnvError,
    WorkerError,
    WorkerTimeoutError,
)
from envhub_sandbox.extras.several_workers.fleet_counters import FleetCounters
from envhub_sandbox.extras.several_workers.part_errors import naming
from envhub_sandbox.extras.several_workers.part_locks import FleetUse
from envhub_sandbox.session.counters import LEDGER, Labels
from envhub_sandbox.session.env_session import GRACE_S, EnvSession
from envhub_sandbox.session.lease import AttributeCache
from envhub_sandbox.session.recorder import Recorder
from envhub_sandbox.session.requests import (
    MessageFor,
    OneMessageFor,
    RequestOrder,
    Requests,
)
from envhub_sandbox.system.log import WORKER
from envhub_sandbox.system.threads import Calls
from envhub_sandbox.transport.deadline import Deadline, StartupDeadline, deadline_of
from envhub_sandbox.transport.jail import Request
from envhub_sandbox.transport.results import Results, StepResult
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import State
from envhub_worker.protocol.shared_memory import slabs
from envhub_worker.protocol.spaces import batches

T = TypeVar("T")
_ENDS_S = 10.0
"""How long to wait for the end of starts that were given up after an interrupt."""
_WORST = (
    *(State.CLOSED, State.FOREIGN, State.DEAD, State.EXPIRED, State.LATE, State.REVIVING),
    *(State.PENDING, State.IDLE, State.READY),
)
"""The order of states from worst to best; several parts are in the worst state of any part."""


class FleetSession:
    """The life of one vector environment in several jails: see ``EnvSession``.
    ``parts``: one session for each worker, in the order of their sub-environments.
    ``recorder``: records for the whole environment; the parts were made with it.
    """

    def __init__(self, parts: Sequence[EnvSession], recorder: Recorder) -> None:
        self.parts = list(parts)
        self.repository = parts[0].repository
        self.manifest = manifest = parts[0].manifest
        self.bounds = [part.rows for part in parts]
        self.counters = FleetCounters([part.counters for part in parts])
        self.lifecycle = FleetLifecycle(parts)
        self.prewarms = [part.prewarm for part in parts]
        results = Results(manifest, self.bounds)
        results.max_bytes = self.repository.wire_limits.message_bytes
        self.requests = FleetRequests(self.parts, results, recorder, self.counters)
        labels = Labels(self.repository.label, manifest.suite, str(manifest.task))
        LEDGER.add(self, labels, self.counters, self.lifecycle)

    @property
    def jails(self) -> int:
        """The number of jails that it uses at a time."""
        return len(self.parts)

    def report(self) -> list[dict[str, Any]]:
        """The layers of every jail, with the number of its worker."""
        return [
            {**layer, "worker": number}
            for number, part in enumerate(self.parts)
            for layer in part.report()
        ]

    def denials(self) -> tuple[str, ...] | None:
        """The denials of all jails; None if they are not recorded."""
        recorded = [denials for part in self.parts if (denials := part.denials()) is not None]
        return tuple(dict.fromkeys(chain.from_iterable(recorded))) if recorded else None

    def usage(self) -> dict[str, int]:
        """What all jails use together; empty if a server does not say."""
        figures = [part.usage() for part in self.parts]
        if not all(figures):
            return {}
        return {name: sum(figure[name] for figure in figures) for name in figures[0]}

    def stats(self) -> dict[str, Any]:
        """The counters of the whole environment, and of each worker."""
        workers = [
            {
                "place": part.lease.place,
                "rows": list(rows),
                "state": part.lifecycle.state.name,
                **self.counters.of_worker(number),
            }
            for number, (part, rows) in enumerate(zip(self.parts, self.bounds, strict=True))
        ]
        whole = self.counters.snapshot()
        return {**whole, "state": self.lifecycle.state.name, "workers": workers}

    def take_apart(self, deadline: Deadline, *, single: bool = False) -> bool:
        """Have infos come apart, in all parts or in none; returns whether they do."""
        results = self.requests.results
        if not results.apart and all(part.may_take_apart for part in self.parts):
            results.apart = all(part.take_apart(deadline) for part in self.parts)
        return results.apart

    def recover(self) -> None:
        """Recover every part before a reset, within the time that one session has for it."""
        grace = Deadline(GRACE_S)
        if any(part.lifecycle.state is State.DEAD for part in self.parts):
            # the same cause may have ended other parts, which have had no request since
            for part in self.parts:
                part.notice_death()
        for part in self.parts:
            with naming(part):
                part.recover(grace)

    def close(self) -> None:
        """Close all parts in parallel; see ``EnvSession.close``."""
        if not (self.requests.use.is_mine or self.lifecycle.closed):
            with contextlib.suppress(RuntimeError):  # no further thread can be started
                Calls([part.close for part in self.parts]).wait()
        self.finalize()

    def finalize(self) -> None:
        """Close every part in turn. A finalizer must start no thread, since the garbage collector
        may call it while a thread is being started."""
        with contextlib.ExitStack() as stack:  # interruption.md, rule 9
            for part in self.parts[::-1]:
                stack.callback(part.close)


class FleetLifecycle:
    """Combines the states of several parts into one: see ``Lifecycle``."""

    def __init__(self, parts: Sequence[EnvSession]) -> None:
        self._parts = [part.lifecycle for part in parts]

    @property
    def state(self) -> State:
        """The worst state of any part."""
        return min((part.state for part in self._parts), key=_WORST.index)

    @property
    def closed(self) -> bool:
        """Whether all parts are closed."""
        return all(part.closed for part in self._parts)


# --- requests to all parts


class FleetRequests(RequestOrder):
    """Sends the requests of one environment to all of its parts: see ``Requests``.

    Args:
        parts: One session for each worker, in the order of their sub-environments.
        results: Joins the parts' results; its bounds are the parts' slices.
        recorder: Records for the whole environment.
        counters: The counters of the whole environment.
    """

    use: FleetUse

    def __init__(
        self,
        parts: Sequence[EnvSession],
        results: Results,
        recorder: Recorder,
        counters: FleetCounters,
    ) -> None:
        self._parts = parts
        self._each: list[Requests] = [part.requests for part in parts]
        use = FleetUse([part.use for part in parts])
        attributes = AttributeCache([part.lease for part in parts], results.bounds)
        super().__init__(parts[0].repository, results, use, attributes)
        self._recorder = recorder
        self._counters = counters
        self._space = results.manifest.single_action_space
        self._may_not_fit = slabs.layout_of(self._space, 1) is None  # steps are messages
        self._unsent: dict[int, Exception] = {}  # failures to send, by part, for ``_of_all``
        self._starting: Calls[None] = Calls([])  # the last start of several parts
        self._sent_ns = 0
        self._first = 0  # the part for which the last step waited first

    @property
    def closed(self) -> bool:
        """Whether the caller has called ``close``; each part keeps it, for its own errors."""
        return self._each[0].closed

    @closed.setter
    def closed(self, closed: bool) -> None:
        for requests in self._each:
            requests.closed = closed

    def note_sent(self, actions: Any | None) -> None:
        """Count and record a step that was sent; see ``RequestOrder``."""
        self._counters.requests += 1
        if actions is not None:
            self._recorder.step(actions)

    def ask_one(self, name: str, index: int, message: OneMessageFor) -> m.Message:
        """Ask only the part that has the sub-environment."""
        with self.use.lock:
            self.refuse_if_busy(f"envs[{index}].{name}")
            if self.before_request is not None:
                self.before_request()
            at = next(i for i, (start, stop) in enumerate(self.results.bounds) if index < stop)
            try:
                with naming(self._parts[at]):
                    return self._each[at].ask_one(name, index, message)
            finally:
                self.note_answered()

    # --- requests ------------------------------------------------------------------------------

    def submit(
        self, operation: str, message_for: MessageFor, instead: MessageFor | None = None
    ) -> None:
        """Send a request to all parts; nothing is sent unless all are ready and all is packed."""
        if self.before_request is not None:
            self.before_request()
        self._make_ready(operation)
        try:
            packed = [requests.pack(operation, message_for, instead) for requests in self._each]
        except LocalProtocolError:
            count = self.results.manifest.num_envs
            self._each[0].refuse_whole(operation, message_for, count)
            raise

        def send(at: int) -> None:
            self._each[at].submit_packed(operation, packed[at])

        self._send(send)
        self._counters.requests += 1
        self._recorder.requested(
            Request(
                packed[0].operation,
                [message for request in packed for message in request.messages],
                [frames for request in packed for frames in request.frames],
                list(self.results.bounds),
                plain=all(request.plain for request in packed),
            )
        )

    def collect(
        self, timeout: float | Deadline | None, kind: type[m.M] | tuple[type[m.M], ...]
    ) -> list[m.M]:
        """Wait for the replies of all parts, in order; see ``Requests.collect``."""
        deadline = deadline_of(timeout)

        def take(at: int) -> list[m.M]:
            return self._each[at].collect(deadline, kind)

        replies = self._of_all(take)
        self.note_answered()
        return [*chain.from_iterable(replies)]

    def one_each(
        self, operation: str, replies: list[m.Value] | list[m.WatchDone]
    ) -> tuple[Any, ...]:
        """One value for each sub-environment; a part that sent another number is given up."""

        def take(at: int) -> tuple[Any, ...]:
            own: list[Any] = [replies[at]]
            return self._each[at].one_each(operation, own)

        return tuple(chain.from_iterable(self._of_all(take)))

    def finish_reset(self, replies: list[m.ResetDone]) -> tuple[Any, dict[Any, Any]]:
        """Turn the parts' replies into one result of ``VectorEnv.reset``; raises as ``collect``."""

        def take(at: int) -> tuple[Any, dict[Any, Any]]:
            return self._each[at].finish_reset([replies[at]])

        return self.results.joined_resets(self._of_all(take))

    # --- steps ---------------------------------------------------------------------------------

    def submit_step(self, actions: Any) -> None:
        """Send each part its rows of the actions; see ``Requests.submit_step``."""
        if self.before_request is not None:
            self.before_request()
        for part in self._parts:
            if part.lifecycle.state is not State.READY:
                self._make_ready("step")
                break
        rows = batches.split(self._space, actions, self.results.bounds)
        packed = self._packed(actions, rows) if self._may_not_fit else [None] * len(rows)
        self._sent_ns = perf_counter_ns()
        each = self._each

        def send(at: int) -> None:
            each[at].submit_step(rows[at], packed[at])

        self._send(send)
        self._counters.requests += 1
        self._recorder.step(actions)

    def _packed(self, actions: Any, rows: Sequence[Any]) -> Sequence[Request | None]:
        """Encode each worker's step before any is sent, since one may be impossible to send.
        Raises ``LocalProtocolError``, with the position in the whole batch of ``actions``.
        """
        try:
            pairs = zip(self._each, rows, strict=True)
            return [requests.pack("step", partial(_step, row)) for requests, row in pairs]
        except LocalProtocolError:
            count = self.results.manifest.num_envs
            self._each[0].refuse_whole("step", partial(_step, actions), count)
            raise

    def collect_step(self, timeout: float | Deadline | None) -> StepResult:
        """Wait for all parts' results of the step, and join them; see ``Requests.collect_step``."""
        deadline: Deadline = self._step_deadline
        if timeout is deadline.timeout_s:
            self._step_deadline.running = False
        else:
            deadline = deadline_of(timeout)
        # Each step begins its wait at another worker, so that the waiting times of the workers can
        # be compared.
        self._first = (self._first + 1) % len(self._each)
        parts = self._of_all(partial(self._collect_step, deadline), self._first)
        self._counters.stepped(perf_counter_ns() - self._sent_ns)
        try:
            result = self.results.joined_steps(parts)
        except RemoteEnvError:
            self._of_all(lambda at: self._each[at].forget_ends(deadline))
            raise
        self.note_answered()
        return result

    def _collect_step(self, deadline: Deadline, at: int) -> StepResult:
        begun_ns = perf_counter_ns()
        try:
            return self._each[at].collect_step(deadline)
        finally:
            self._counters.waited(at, perf_counter_ns() - begun_ns)

    # --- all parts together ----------------------------------------------------------------------

    def _make_ready(self, operation: str) -> None:
        states = [requests.lifecycle.state for requests in self._each]
        idle = [at for at, state in enumerate(states) if state is State.IDLE]
        for at, requests in enumerate(self._each):
            if at not in idle:
                with naming(self._parts[at]):
                    requests.make_ready(operation)
        if idle:
            started = self._start([self._parts[at] for at in idle])
            for at, start in zip(idle, started, strict=True):
                with naming(self._parts[at]):
                    self._each[at].make_ready(operation, start)

    def _start(self, parts: Sequence[EnvSession]) -> list[Callable[[], None]]:
        """Start parts in parallel while this thread holds their locks. Returns a function for each
        part that raises the error of its start, if it failed.
        """
        self._wait_for_starts()
        parts[0].prewarm.note_use()  # first, so that the next task starts in parallel
        startup_s = self._timeouts.startup_s
        deadlines = [StartupDeadline(startup_s) for _ in parts]
        pairs = zip(parts, deadlines, strict=True)
        starts = [partial(part.prewarm.start_on_demand, deadline) for part, deadline in pairs]
        self._starting = starting = Calls(starts)
        try:
            self._starting.wait()
        except BaseException:  # interruption.md, rule 18
            for deadline in deadlines:
                deadline.give_up()
            self._wait_for_starts()
            raise
        return [start.result for start in starting.each]

    def _wait_for_starts(self) -> None:
        if not self._starting.wait(_ENDS_S):
            raise WorkerTimeoutError("processes are still being started; call reset() again")

    def _send(self, send: Callable[[int], None]) -> None:
        """Send to each part; keep the failures of all but the first part for ``_of_all``."""
        # If the first part fails, nothing was sent and the error is raised at once. Later, other
        # parts owe answers: the failed part moves to LATE, and ``_of_all`` raises its error after
        # it has taken the answers of the others (interruption.md, rule 17).
        self._unsent = {}
        for at in range(len(self._parts)):
            try:
                send(at)
            except Exception as error:
                if at == 0:
                    with naming(self._parts[at]):
                        raise
                self._unsent[at] = error
                self._each[at].fall_behind()

    def _of_all(self, take: Callable[[int], T], first: int = 0) -> list[T]:
        """Call ``take`` for every part, then raise the first failure: interruption.md, rule 17."""
        failures, self._unsent = self._unsent, {}
        taken: dict[int, T] = {}
        count = len(self._parts)
        for at in chain(range(first, count), range(first)):
            if at not in failures:
                try:
                    taken[at] = take(at)
                except Exception as error:
                    failures[at] = error
        if failures:
            self._fail(failures)
        return [taken[at] for at in range(count)]

    def _fail(self, failures: dict[int, Exception]) -> None:
        # a death or a late reply comes first, as it does with several processes in one jail
        fatal = [at for at, error in failures.items() if isinstance(error, WorkerError)]
        first = min(fatal or failures)
        error = failures.pop(first)
        for other in failures.values():
            WORKER.info("%s: also: %s", self._repository.label, other)
        try:
            with naming(self._parts[first]):
                raise error
        finally:
            self.explain(error)


def _step(actions: Any, number: int, bounds: tuple[int, int]) -> m.Message:
    return m.Step(number, actions)
