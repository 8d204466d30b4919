"""An environment as the tenant of a jail: how it moves in, moves on, and closes for good.

Nothing here knows what is asked of it, nor why a jail has to be left.
"""

from __future__ import annotations

import contextlib
import os
import threading
import weakref
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from envhub_sandbox.crash.history import History
from envhub_sandbox.errors import EnvHubError, WorkerDiedError, WorkerError
from envhub_sandbox.log import WORKER
from envhub_sandbox.session.counters import LEDGER, Counters, Labels
from envhub_sandbox.session.jail_sources import JailSource
from envhub_sandbox.session.launcher import LoadedJail, Repository
from envhub_sandbox.session.placement import Builder, Place
from envhub_sandbox.session.restart_policy import Restarts
from envhub_sandbox.transport.deadline import Deadline, StartupDeadline
from envhub_sandbox.transport.lane import Lane
from envhub_sandbox.transport.results import Results
from envhub_sandbox.transport.shared_memory.sharding import PaceBook
from envhub_worker.protocol import messages as m
from envhub_worker.protocol.lifecycle import Event, Lifecycle, State
from envhub_worker.protocol.manifest import EnvManifest

_INTERRUPT_S = 10.0
"""How long ``close`` waits at most for another thread to notice that the jail has gone: no longer
than it waits for the environment's own ``close``."""
_WITHOUT_A_JAIL = frozenset({State.EXPIRED, State.DEAD, State.FOREIGN, State.CLOSED})
"""It may not have been given back yet."""


class Tenant:
    """The life of one environment in its jails, of which it has one at a time, or none.

    ``close`` may come from any thread at any time, and from a signal handler; everything else is
    for one thread at a time. It is a base, not a part, so that a step needs no detour to its lane.

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
        self.results = Results(manifest, self.bounds)
        self.lifecycle = Lifecycle()
        self.counters = Counters()
        self.history = History(manifest, jails.repository.policy.crash_history)
        self._paces = paces
        self._jails = jails
        self._lock = threading.RLock()  # a signal handler may close what its own thread waits for
        self._ending = threading.RLock()  # nothing is given back that another thread is ending
        self._owner = os.getpid()
        self._builder = Builder(jails, self.results)
        self._restarts = Restarts(jails.repository.policy)
        self._loaded: LoadedJail | None = None
        self._lane: Lane | None = None
        self._release_server: Callable[[], None] = _nothing
        self._startup: StartupDeadline | None = None
        self._warm = False  # started ahead, and not used yet
        self._warming: StartupDeadline | None = None
        self._first_use: Callable[[], None] | None = None
        self._make_room: Callable[[], bool] = _no_room
        self._departs = weakref.finalize(self, jails.repository.stay())
        self._departs.atexit = False
        labels = Labels(self.repository.label, manifest.suite, str(manifest.task))
        LEDGER.add(self, labels, self._restarts)
        _living.add(self)

    @property
    def repository(self) -> Repository:
        """The repository that it comes from."""
        return self._jails.repository

    @property
    def closed(self) -> bool:
        """Whether it is closed for good."""
        return self.lifecycle.state is State.CLOSED

    def report(self) -> list[dict[str, Any]]:
        """The layers of the jail that it lives in; none where it does not live in any."""
        loaded = self._loaded  # another thread may give it back
        if loaded is None or self.lifecycle.state in _WITHOUT_A_JAIL:
            return []
        return loaded.jail.report

    def stats(self) -> dict[str, Any]:
        """Counters, and where it is in its life."""
        found = self.counters.snapshot()
        return {**found, "restarts": self._restarts.count, "state": self.lifecycle.state.name}

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

    def _closed(self, operation: str) -> WorkerDiedError:
        text = f"the environment was closed during {operation}"
        return WorkerDiedError(text, reason="killed", request=operation)

    def _moved(self, event: Event) -> None:
        # close() may have come meanwhile, from another thread
        if self.lifecycle.state is not State.CLOSED:
            self.lifecycle.on(event)

    # --- moving in -----------------------------------------------------------------------------

    def adopt(self, loaded: LoadedJail) -> None:
        """Use a jail that is already loaded, instead of opening one later."""
        with self._turn("make_env"):
            self._build(loaded, Deadline(self.repository.timeouts.startup_s))

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
            loaded, used = self._loaded, self.counters.requests
            if not self._warm or used or loaded is None or self.lifecycle.state is not State.READY:
                return warming is not None
            with self._turn("make_env"):
                self._warm = False
                self._close_politely(loaded)
                self._give_back()
                self._moved(Event.FORGET)
            return True
        finally:
            self._lock.release()

    def on_first_use(self, used: Callable[[], None], make_room: Callable[[], bool]) -> None:
        """Whom to tell that it is used, and whom to ask where a server has no place left."""
        self._first_use, self._make_room = used, make_room

    def _note_first_use(self) -> None:
        if self._first_use is not None:
            tell, self._first_use = self._first_use, None
            tell()

    def _look_whether_warm_lives(self) -> None:
        """What was started ahead and has died unused is started again, as if it never had been."""
        self._warm = False
        if self._loaded is None or self.lifecycle.state is not State.READY:
            return
        try:
            self._loaded.jail.output("make_env", Deadline(_INTERRUPT_S))
        except EnvHubError:
            self._forget()

    def _start(self, deadline: StartupDeadline | None = None) -> None:
        deadline = self._startup = deadline or StartupDeadline(self.repository.timeouts.startup_s)
        try:
            self._build(self._take_jail(deadline), deadline)
        except EnvHubError:
            if self.lifecycle.state is State.CLOSED:
                raise self._closed("make_env") from None
            raise
        finally:
            self._startup = None
            self._let_server_go()

    def _take_jail(self, deadline: Deadline) -> LoadedJail:
        try:
            return self._jails.take(deadline)
        except WorkerError as error:
            # of this very type: the server's refusal, which may be for want of room
            if type(error) is not WorkerError or deadline.unasked or not self._make_room():
                raise
        return self._jails.take(deadline)

    def _build(self, loaded: LoadedJail, deadline: Deadline) -> None:
        with self.repository.starting(deadline):
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
        self._loaded, self._lane = place.loaded, place.lane
        self.counters.connected(place.lane)

    # --- moving out ----------------------------------------------------------------------------

    def _forget(self) -> None:
        """Give up the jail; the next request opens another, in the same server."""
        WORKER.info("%s: the jail is given up for a fresh one", self.repository.label)
        self._leave()
        self.lifecycle.request = None
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

    def _close_lane(self) -> None:
        lane, self._lane = self._lane, None
        if lane is not None:
            self.counters.connected(None)
            lane.close()

    def _let_server_go(self) -> None:
        release, self._release_server = self._release_server, _nothing
        release()

    def _let_go(self) -> None:
        """Give back whatever is left of it. A fork of its owner gives back nothing."""
        if os.getpid() != self._owner:
            return
        try:
            self._give_back()
        finally:
            self._let_server_go()
            self._departs()

    # --- the end -------------------------------------------------------------------------------

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

    def _close_politely(self, loaded: LoadedJail) -> None:
        """Let the repository's ``close`` run; whatever it does, the processes end after it."""
        deadline = Deadline(self.repository.timeouts.close_s)
        lane = self._lane
        if lane is None:
            return
        requests = [(runner, m.Close(lane.number)) for runner in lane.runners]
        with contextlib.suppress(EnvHubError):
            loaded.jail.receive(loaded.jail.send("close", requests), deadline)

    def _note_pace(self) -> None:
        pace = self._lane and self._lane.pace()
        if pace:
            self._paces.note(self.manifest, pace)

    def _interrupt(self) -> None:
        """Another thread waits for a reply: end the jail under it, then clean up after it.

        If it does not let go in time it cleans up itself, once it sees that this was closed: no
        process is left for it to end.
        """
        with self._ending:
            self._moved(Event.CLOSE)
            self._restarts.give_up()
            loaded, startup = self._loaded, self._startup
            if startup is not None:
                startup.give_up()
            if loaded is None:
                return  # whoever brings one sees that it is closed
            self._jails.end(loaded)
        close_s = self.repository.timeouts.close_s
        patience_s = _INTERRUPT_S if close_s is None else min(close_s, _INTERRUPT_S)
        if self._lock.acquire(timeout=patience_s):
            try:
                self._moved(Event.CLOSE)  # the other may have moved at the same moment
                self._let_go()  # of what is there now: it may have moved elsewhere, too
            finally:
                self._lock.release()

    def abandon(self) -> None:
        """In a fork of the process that made it: touch nothing, and refuse from now on."""
        self._lock = threading.RLock()  # whichever thread held it is not here
        self._ending = threading.RLock()
        if self.lifecycle.state is not State.CLOSED:
            self.lifecycle.on(Event.FORK)
        self.lifecycle.request, self._release_server = None, _nothing
        self._close_lane()


_living: weakref.WeakSet[Tenant] = weakref.WeakSet()


def _abandon_all() -> None:
    for env in list(_living):
        env.abandon()


os.register_at_fork(after_in_child=_abandon_all)


def _nothing() -> None:
    """There is nothing to give back."""


def _no_room() -> bool:
    """Nothing was started ahead that could be given up."""
    return False
