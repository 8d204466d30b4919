"""A suite's hold on its worker server, between two of its jails."""

from __future__ import annotations

import threading
from collections.abc import Callable

from envhub_sandbox.sandboxes.base import WorkerServer
from envhub_sandbox.session.jails.partings import Partings
from envhub_sandbox.transport.forks import Owner


class ServerHold:
    """Keeps a server from the first jail on until the last environment is closed. Thread-safe.

    An evaluation closes each task before it opens the next, and may think in between for longer
    than a server lingers.

    Args:
        acquire: Asks for the server.
        release: Gives it back.

    Attributes:
        partings: The ends of jails in it that have not been waited for.
    """

    def __init__(
        self, acquire: Callable[[], WorkerServer], release: Callable[[WorkerServer], None]
    ) -> None:
        self._acquire, self._release = acquire, release
        self.partings = Partings()
        # reentrant: the garbage collector may close an environment in the midst of this
        self._lock = threading.RLock()
        self._owner = Owner()
        self._open: set[object] = set()
        self._server: WorkerServer | None = None

    def enter(self) -> Callable[[], None]:
        """There is one environment more; returns what says that it is closed. Idempotent."""
        ticket = object()
        with self._lock:
            self._open.add(ticket)
        return lambda: self._leave(ticket)

    def keep(self, used: WorkerServer) -> None:
        """A jail is opened in a server: keep that, if there are environments to come."""
        before = None
        with self._lock:
            if not self._open or self._server is used:
                return
            server = self._acquire()
            before, self._server = self._server, server
        if before is not None:
            self._release(before)  # it has died

    def goes_on(self, server: WorkerServer) -> bool:
        """Whether this one is kept for more than the one who asks."""
        with self._lock:
            return self._server is server and len(self._open) > 1

    def _leave(self, ticket: object) -> None:
        if not self._owner.is_here:
            return  # a fork: the server is the parent's, and somebody may have held the lock
        with self._lock:
            self._open.discard(ticket)
            if self._open or self._server is None:
                return
            server, self._server = self._server, None
        try:
            self.partings.settle()
        finally:
            self._release(server)
