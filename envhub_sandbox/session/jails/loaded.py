"""An open jail whose runners have called ``make_env``, and a suite's hold on its worker server."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from envhub_sandbox.sandboxes.pool import ServerUse, WorkerServer
from envhub_sandbox.system.processes import OwnerProcess
from envhub_worker.protocol.manifest.manifest import EnvManifest, Manifest
from envhub_worker.protocol.records import dataclass

if TYPE_CHECKING:
    from envhub_sandbox.transport.jail import JailHandle


@dataclass(frozen=True)
class ExpectedManifest:
    """What a repository's ``make_env`` has returned before.

    Attributes:
        task: The environment that a jail is wanted for.
        shards: Over how many runners it is going to be spread.
    """

    manifest: Manifest
    task: EnvManifest
    shards: int = 1


class LoadedJail:
    """An open jail whose first runner has called ``make_env``.

    It has to be given back. Where a Ctrl-C comes between its taking and its noting, its
    finalizer does.

    Attributes:
        manifest: What ``make_env`` returned, checked.
        loaded: Runners that have called it.
        use: That of the server that it is in.
        address: What errors call the place of that.
        give_back: Gives it back: see ``Launcher.close`` and ``disconnect``.
        ending: Whether its end was begun.
        closing: Whether a call of ``Launcher.close`` is at it.
        ended: Whether it was asked for, so that only the server's use is left.
        closed: Whether all was given back.
        lost: Whether the connection to its server was.
        changed: Whether it returned something else in one of them than the manifest says.
    """

    def __init__(
        self,
        jail: JailHandle,
        manifest: Manifest,
        value: dict[str, object],
        loaded: set[int],
        use: ServerUse[WorkerServer],
        give_back: Callable[[LoadedJail], None],
        address: str = "",
    ) -> None:
        self.jail = jail
        self.manifest = manifest
        self.value = value
        self.loaded = loaded
        self.use = use
        self.give_back = give_back
        self.address = address
        self.ending = self.closing = self.ended = self.closed = self.lost = self.changed = False
        self.owner = OwnerProcess()

    @property
    def server(self) -> WorkerServer:
        """Where it is."""
        return self.use.server

    def __del__(self) -> None:
        # interruption.md, rule 5. At the end of the process no server is in use any more: nothing
        # is closed one by one there (rule 13).
        if "owner" not in vars(self):  # the last field: an interrupt came before there was a jail
            return
        if not self.closed and self.use.live and self.owner.is_here:
            self.ending = True  # its connection may have gone before it
            self.give_back(self)


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
