"""Starts an environment's processes, at its first request or ahead of it (prewarming).

An evaluation plays task after task, and each task needs time for processes, imports and simulators
before its first ``reset`` returns. The next task can start in the background while one is played.
Results do not depend on that: if a start ahead fails, the first request repeats it.
"""

from __future__ import annotations

import contextlib
import threading
import weakref
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import chain

from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.session.failures import Recovery
from envhub_sandbox.session.launcher import LoadedJail
from envhub_sandbox.session.lease import Lease, closed_during
from envhub_sandbox.session.recorder import Recorder
from envhub_sandbox.session.use_lock import UseLock
from envhub_sandbox.system.log import WORKER
from envhub_sandbox.transport.deadline import Deadline, StartupDeadline
from envhub_worker.protocol.lifecycle import Event, State

LOOK_S = 10.0
"""How long to wait for the server to say whether a jail still lives."""
INTERRUPT_S = 10.0
"""The longest that ``close`` waits for another thread to notice the end of the jail."""
_GOING_S = 30.0
"""How long a jail that is given up may take to run its ``close`` and end its processes."""


class Prewarm:
    """Starts the processes of one environment, and cancels a start ahead that was never used.

    Attributes:
        unused: Whether the environment was started ahead and has had no reset yet.
        first_use: Called at the first request; None afterwards.
        starting: The deadline of a start ahead that is running and holds the use lock; else None.
    """

    def __init__(
        self, lease: Lease, use: UseLock, recorder: Recorder, recovery: Recovery | None
    ) -> None:
        self.lifecycle = lease.lifecycle
        self.unused = False
        self.first_use: Callable[[], None] | None = None
        self._lease = lease
        self._use = use
        self._counters = lease.counters
        self._recorder = recorder
        self._recovery = recovery
        self._timeouts = lease.repository.timeouts
        self.starting: StartupDeadline | None = None

    @property
    def closed(self) -> bool:
        """Whether the environment is closed for good."""
        return self.lifecycle.closed

    # --- for a request -------------------------------------------------------------------------

    def start_on_demand(self, deadline: StartupDeadline | None = None) -> None:
        """Take a jail, and build the environment in it; raises as ``Lease.acquire`` does."""
        try:
            self._lease.acquire(deadline or StartupDeadline(self._timeouts.startup_s))
        except EnvHubError:
            if self.lifecycle.closed:
                raise closed_during("make_env") from None
            raise
        self._started()

    def adopt(self, loaded: LoadedJail) -> None:
        """Build in a jail that is loaded already, instead of opening one later."""
        with self._use.hold("make_env"):
            self._lease.adopt(loaded, Deadline(self._timeouts.startup_s))
            self._started()

    def _started(self) -> None:
        self._recorder.started()
        if self._recovery is not None:
            self._recovery.started()
        self.lifecycle.on(Event.START)

    # --- ahead of requests -----------------------------------------------------------------------

    def start_in_background(self) -> None:
        """Start the processes in a thread, unless they are started already."""
        if self.lifecycle.state is State.IDLE:
            threading.Thread(target=self.start, name="envhub-prewarm", daemon=True).start()

    def start(self) -> None:
        """Start the processes ahead of any request, unless they are started already."""
        deadline = StartupDeadline(self._timeouts.startup_s, unasked=True)
        # errors are dropped: the first request tries again, and raises its error
        with contextlib.suppress(Exception), self._use.hold("make_env"):
            if self.lifecycle.state is State.IDLE:
                self.starting = deadline
                try:
                    self.start_on_demand(deadline)
                    self.unused = True
                finally:
                    self.starting = None

    def cancel(self) -> bool:
        """End processes that were started ahead and never used; returns whether there were any."""
        starting = self.starting
        if starting is not None:
            starting.give_up()
        lock = self._use.lock
        if not lock.acquire(timeout=0 if starting is None else INTERRUPT_S):
            return False  # a request holds the lock
        try:
            unused = self.unused and not self._counters.requests
            if not unused or self.lifecycle.state is not State.READY:
                return starting is not None
            with self._use.hold("make_env"):
                self.unused = False
                # interruption.md, rule 1: the state moves first, so a reset starts another jail
                self.lifecycle.moved(Event.EXPIRY)
                try:
                    self._lease.close_politely()
                finally:  # a filter of the caller may raise its warnings
                    self._lease.give_back()
                    self.lifecycle.moved(Event.FORGET)
            return True
        finally:
            lock.release()

    def look_whether_it_lives(self) -> None:
        """Before a reset, move to EXPIRED if a jail that was started ahead has died unused."""
        if not self.unused:
            return
        self.unused = False
        if self.lifecycle.state is not State.READY:
            return
        try:
            self._lease.look("make_env", Deadline(LOOK_S))
        except EnvHubError:
            self.lifecycle.moved(Event.EXPIRY)  # as in cancel

    # --- the first use -------------------------------------------------------------------------

    def on_first_use(
        self, first_use: Callable[[], None] | None, make_room: Callable[[], bool]
    ) -> None:
        """Set the functions to call at the first request, and when a server has no room."""
        self.first_use, self._lease.make_room = first_use, make_room

    def note_use(self) -> None:
        """Call ``first_use``, once."""
        if self.first_use is not None:
            first_use, self.first_use = self.first_use, None
            first_use()


_Task = tuple["weakref.ref[Prewarm]", ...]
"""The workers of one environment; weak, so that an environment without an owner is closed."""


class SuitePrewarm:
    """Starts the tasks that follow the last used one, and cancels tasks that were skipped.

    Thread-safe. Each task is started in a thread of its own. So if a start takes longer than
    playing, the next start begins while a request still waits for the last one.
    ``suites``: the tasks of each suite in order; each task is the sequence of its workers.
    ``count``: how many tasks to start ahead, and so the largest number of unused jails. None means
    one, but only after a task was closed before the next was used: a program that uses one task,
    or all at once, starts nothing ahead.
    """

    def __init__(self, suites: Sequence[Sequence[Sequence[Prewarm]]], count: int | None) -> None:
        self._count = count
        self._suites = [[tuple(map(weakref.ref, task)) for task in suite] for suite in suites]
        self._lock = threading.Lock()
        self._cancelled = threading.Condition(self._lock)
        self._wanted: list[_Task] = []  # to be started next, in their order
        self._tried: set[_Task] = set()  # used or started once: not started ahead again
        self._ahead: list[_Task] = []  # started here and not used yet
        self._cancelling = 0  # tasks that threads cancel now
        for task in chain.from_iterable(self._suites):
            hash(task)  # weak references keep a hash that was computed while their object lived
            for worker in _living(task):
                worker.on_first_use(partial(self._used, task), self.make_room)

    def make_room(self) -> bool:
        """Cancel all unused starts, since a server has no room; returns whether there were any."""
        with self._lock:
            self._wanted = []
            ahead, self._ahead = self._ahead, []
            going = self._cancelling > 0
        cancelled = [worker.cancel() for task in ahead for worker in _living(task)]
        with self._lock:  # jails that other threads are cancelling make room, too, once they end
            self._cancelled.wait_for(lambda: not self._cancelling, _GOING_S)
        return going or any(cancelled)

    def _used(self, used: _Task) -> None:
        """Note the first request to a task, and start the tasks that follow it."""
        for worker in _living(used):
            worker.first_use = None
        with self._lock:
            self._tried.add(used)
            self._ahead = [task for task in self._ahead if task != used]
            self._wanted = list(self._following(used))
            self._start_threads()

    def _start_threads(self) -> None:
        """Cancel or start tasks, each in a thread of its own. The caller holds the lock.

        If no thread can be started, that is only logged: the caller's request is to another task
        and must not fail.
        """
        while (todo := self._next()) is not None:
            thread = threading.Thread(
                target=self._run, args=todo, name="envhub-prewarm", daemon=True
            )
            try:
                thread.start()
            except RuntimeError as error:
                WORKER.info("nothing is started ahead: %s", error)
                self._cancelling -= not todo[1]
                self._cancelled.notify_all()
                return

    def _following(self, used: _Task) -> Iterator[_Task]:
        suite = next(suite for suite in self._suites if used in suite)
        index = suite.index(used)
        count = self._count
        if count is None:
            count = 1 if index and _is_closed(suite[index - 1]) else 0
        left = [
            task for task in suite[index + 1 :] if task in self._ahead or task not in self._tried
        ]
        yield from [task for task in left if not _is_closed(task)][:count]

    def _run(self, task: list[Prewarm], start: bool) -> None:
        try:
            with contextlib.suppress(Exception):  # the first request to the task fails the same way
                if start and len(task) > 1:
                    from envhub_sandbox.system.threads import Calls  # which few need

                    Calls([worker.start for worker in task]).wait()
                else:
                    for worker in task:
                        worker.start() if start else worker.cancel()
        finally:
            if not start:
                with self._lock:
                    self._cancelling -= 1
                    self._start_threads()
                    self._cancelled.notify_all()

    def _next(self) -> tuple[list[Prewarm], bool] | None:
        """The next task to cancel (False) or to start (True).

        Nothing starts before all cancelled tasks have ended, so there are never more than
        ``count`` unused jails.
        """
        for task in [task for task in self._ahead if task not in self._wanted]:
            self._ahead.remove(task)
            self._tried.discard(task)
            if workers := _living(task):
                self._cancelling += 1
                return workers, False
        untried = [task for task in self._wanted if task not in self._tried]
        for task in [] if self._cancelling else untried:
            self._tried.add(task)
            if workers := _living(task):
                self._ahead.append(task)
                return workers, True
        return None


def _living(task: _Task) -> list[Prewarm]:
    return [worker for ref in task if (worker := ref()) is not None]


def _is_closed(task: _Task) -> bool:
    return all(worker.closed for worker in _living(task))
