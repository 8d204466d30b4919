"""The start of an environment's processes: when somebody asks for them, or ahead of that."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable

from envhub_sandbox.crash.history import History
from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.session.counters import Counters
from envhub_sandbox.session.jails.loaded import LoadedJail
from envhub_sandbox.session.lease import Lease
from envhub_sandbox.session.refusals import closed_during
from envhub_sandbox.session.survival.recovery import Recovery
from envhub_sandbox.session.turns import Turns
from envhub_sandbox.transport.deadline import Deadline, StartupDeadline
from envhub_worker.protocol.lifecycle import Event, State

LOOK_S = 10.0
"""How long a look at a jail that may have died may take."""
INTERRUPT_S = 10.0
"""How long ``close`` waits at most for another thread to notice that the jail has gone: no longer
than it waits for the environment's own ``close``."""


class HeadStart:
    """Starts one environment, and gives up what was started ahead and nobody has used.

    Args:
        lease: Its hold on a jail.
        turns: Whose turn it is.
        counters: Say whether anything was asked of it.
        history: Told that it has started.
        recovery: Told that it has started.
    """

    def __init__(
        self, lease: Lease, turns: Turns, counters: Counters, history: History, recovery: Recovery
    ) -> None:
        self.lifecycle = lease.lifecycle
        self._lease = lease
        self._turns = turns
        self._counters = counters
        self._history = history
        self._recovery = recovery
        self._timeouts = lease.repository.timeouts
        self._warm = False  # started ahead, and not used yet
        self._warming: StartupDeadline | None = None
        self._first_use: Callable[[], None] | None = None

    # --- asked for -----------------------------------------------------------------------------

    def start(self) -> None:
        """Take a jail, and build the environment in it; raises as ``Lease.acquire`` does."""
        self._start(StartupDeadline(self._timeouts.startup_s))

    def adopt(self, loaded: LoadedJail) -> None:
        """Use a jail that is already loaded, instead of opening one later."""
        with self._turns.take("make_env"):
            self._lease.adopt(loaded, Deadline(self._timeouts.startup_s))
            self._started()

    def _start(self, deadline: StartupDeadline) -> None:
        try:
            self._lease.acquire(deadline)
        except EnvHubError:
            if self.lifecycle.closed:
                raise closed_during("make_env") from None
            raise
        self._started()

    def _started(self) -> None:
        self._history.started()
        self._recovery.started()
        self.lifecycle.on(Event.START)

    # --- ahead ---------------------------------------------------------------------------------

    def prewarm(self) -> None:
        """Start its processes in a thread of their own, unless they are there."""
        if self.lifecycle.state is State.IDLE:
            threading.Thread(target=self.warm_up, name="envhub-prewarm", daemon=True).start()

    def warm_up(self) -> None:
        """Start its processes, unless they are there, although nobody has asked for them yet."""
        deadline = StartupDeadline(self._timeouts.startup_s, unasked=True)
        # whatever goes wrong: the first request meets it again, and somebody hears of it there
        with contextlib.suppress(Exception), self._turns.take("make_env"):
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
        lock = self._turns.lock
        if not lock.acquire(timeout=0 if warming is None else INTERRUPT_S):
            return False  # somebody uses it
        try:
            unused = self._warm and not self._counters.requests
            if not unused or self.lifecycle.state is not State.READY:
                return warming is not None
            with self._turns.take("make_env"):
                self._warm = False
                self.lifecycle.moved(Event.EXPIRY)  # first: an interrupt must not leave it READY
                self._lease.close_politely()
                self._lease.give_back()
                self.lifecycle.moved(Event.FORGET)
            return True
        finally:
            lock.release()

    def look_whether_it_lives(self) -> None:
        """What was started ahead and has died unused has expired, as if it never had been."""
        if not self._warm:
            return
        self._warm = False
        if self.lifecycle.state is not State.READY:
            return
        try:
            self._lease.look("make_env", Deadline(LOOK_S))
        except EnvHubError:
            self.lifecycle.moved(Event.EXPIRY)  # as in cool_down

    # --- the first use -------------------------------------------------------------------------

    def on_first_use(self, used: Callable[[], None], make_room: Callable[[], bool]) -> None:
        """Whom to tell that it is used, and whom to ask where a server has no place left."""
        self._first_use, self._lease.make_room = used, make_room

    def note_use(self) -> None:
        """Something is asked of it."""
        if self._first_use is not None:
            tell, self._first_use = self._first_use, None
            tell()

    def note_if_awaited(self) -> None:
        """Who asks for what is on its way up uses it: the next one need not wait for that."""
        if self._warming is not None:
            self.note_use()
