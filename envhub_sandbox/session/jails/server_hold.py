"""A suite's hold on its worker server, between two of its jails."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from envhub_sandbox.sandboxes.pool import ServerUse, WorkerServer
from envhub_sandbox.system.processes import OwnerProcess


class ServerHold:
    """Keeps a server from the first jail on until the last environment is closed. Thread-safe.

    An evaluation closes each task before it opens the next, and may think in between for longer
    than an idle server is kept. Nor does it wait for each jail's end: that takes some 20 ms, for
    the kernel has to take memory and mounts away. So closing one environment of several only asks
    for the end, and who closes the next one waits for it, or who closes the last.

    Args:
        on_enter: Called when there is one environment more.
        on_empty: Called when the last one is closed; where that is interrupted, again.
    """

    def __init__(
        self,
        acquire: Callable[[], ServerUse[Any]],
        on_enter: Callable[[], None],
        on_empty: Callable[[], None],
    ) -> None:
        self._acquire = acquire
        self._on_enter = on_enter
        self._on_empty = on_empty
        # interruption.md, rule 12
        self._lock = threading.RLock()
        self._owner = OwnerProcess()
        self._open: set[object] = set()
        self._use: ServerUse[Any] | None = None
        self._left: list[ServerUse[Any]] = []
        # without the lock, since waits may be added while one is waited for: a list is enough, as
        # what one caller has taken from it no other waits for
        self._pending_closes: list[Callable[[], None]] = []

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
            if self._use is not None:  # its server has died
                self._left.append(self._use)
            self._use = use
        self._let_go()

    def close_later(self, server: WorkerServer, wait: Callable[[], None]) -> bool:
        """Have the next close wait for the end of a jail; False if no other is to come.

        Waits for the ends before this one, most of which have come.
        """
        with self._lock:
            if not self._is_kept(server) or len(self._open) <= 1:
                return False
        self.settle()
        self._pending_closes.append(wait)
        return True

    def settle(self) -> bool:
        """Wait for the jails that are on their way out; whether there was one."""
        found = False
        while self._pending_closes:
            try:
                wait = self._pending_closes.pop()
            except IndexError:  # another thread was faster
                break
            found = True
            wait()
        return found

    def _is_kept(self, server: WorkerServer) -> bool:
        use = self._use
        return use is not None and use.live and use.server is server

    def _leave(self, ticket: object) -> None:
        """If interrupted, the next call finishes the work: interruption.md, rule 7."""
        if not self._owner.is_here:
            return  # a fork: the server is the parent's, and another thread may have held the lock
        with self._lock:
            self._open.discard(ticket)
            if not self._open and self._use is not None:
                self._left.append(self._use)
                self._use = None
        try:
            if self._left:
                self.settle()
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
