"""A suite's hold on its worker server, between two of its jails."""

from __future__ import annotations

import threading
from collections.abc import Callable

from envhub_sandbox.sandboxes.base import ServerUse, WorkerServer
from envhub_sandbox.session.jails.partings import Partings
from envhub_sandbox.transport.forks import Owner


class ServerHold:
    """Keeps a server from the first jail on until the last environment is closed. Thread-safe.

    An evaluation closes each task before it opens the next, and may think in between for longer
    than a server lingers.

    Args:
        acquire: Asks for a use of the server.
        on_enter: Called when there is one environment more.
        on_empty: Called when the last one is closed; where that is interrupted, again.

    Attributes:
        partings: The ends of jails in it that have not been waited for.
    """

    def __init__(
        self,
        acquire: Callable[[], ServerUse],
        on_enter: Callable[[], None],
        on_empty: Callable[[], None],
    ) -> None:
        self._acquire = acquire
        self._on_enter = on_enter
        self._on_empty = on_empty
        self.partings = Partings()
        # interruption.md, rule 12
        self._lock = threading.RLock()
        self._owner = Owner()
        self._open: set[object] = set()
        self._use: ServerUse | None = None
        self._left: list[ServerUse] = []

    def enter(self) -> Callable[[], None]:
        """There is one environment more; returns what says that it is closed. Idempotent."""
        ticket = object()
        with self._lock:
            self._on_enter()
            self._open.add(ticket)
        return lambda: self._leave(ticket)

    def keep(self, used: WorkerServer) -> None:
        """A jail is opened in a server: keep that, if there are environments to come."""
        with self._lock:
            if not self._open or self._is_kept(used):
                return
            use = self._acquire()
            if self._use is not None:  # it has died
                self._left.append(self._use)
            self._use = use
        self._let_go()

    def goes_on(self, server: WorkerServer) -> bool:
        """Whether this one is kept for more than the one who asks."""
        with self._lock:
            return self._is_kept(server) and len(self._open) > 1

    def _is_kept(self, server: WorkerServer) -> bool:
        use = self._use
        return use is not None and use.live and use.shared is server

    def _leave(self, ticket: object) -> None:
        """What interrupts it, whoever leaves next goes on after, and may be the same."""
        if not self._owner.is_here:
            return  # a fork: the server is the parent's, and somebody may have held the lock
        with self._lock:
            self._open.discard(ticket)
            if not self._open and self._use is not None:
                self._left.append(self._use)
                self._use = None
        try:
            if self._left:
                self.partings.settle()
        finally:
            self._let_go()
        with self._lock:
            if not self._open:
                self._on_empty()

    def _let_go(self) -> None:
        for use in list(self._left):
            use.release()
            with self._lock:
                if use in self._left:
                    self._left.remove(use)
