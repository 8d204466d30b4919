"""Where environments get their jail from: one of their own each, or one that they share.

A suite whose environments are built lazily has a jail per task in use, so that closing one frees
its processes. Where ``make_env`` has already built all of them, they live in one jail.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable

from envhub_sandbox.session.jails.launcher import Launcher
from envhub_sandbox.session.jails.loaded import ExpectedManifest, LoadedJail
from envhub_sandbox.system.processes import OwnerProcess
from envhub_sandbox.transport.deadline import Deadline


class JailSource:
    """Gives each environment a jail of its own, and takes it back.

    Args:
        forget_manifest: Drops the remembered manifest, when a jail contradicts it.
        expected: What such a jail is going to be.

    Attributes:
        shared: Whether several environments live in one jail.
    """

    shared = False

    def __init__(
        self,
        launcher: Launcher,
        forget_manifest: Callable[[], None],
        expected: ExpectedManifest | None = None,
    ) -> None:
        self.launcher = launcher
        self.forget_manifest = forget_manifest
        self._expected = expected

    def take(self, deadline: Deadline) -> LoadedJail:
        """A jail for one environment."""
        return self.launcher.open(deadline, self._expected)

    def end(self, loaded: LoadedJail) -> None:
        """End the jail now, over another connection: a thread may wait on its own."""
        self.launcher.interrupt(loaded)

    def give_back(self, loaded: LoadedJail, *, wait: bool = True) -> None:
        """Drop the connection; the last user's jail ends, which one need not wait for."""
        self.launcher.close(loaded, wait=wait)


class SharedJail(JailSource):
    """One jail for all environments of a repository, each with a connection of its own.

    A death or a time-out of one environment takes the others' process along: they share it.
    """

    shared = True

    def __init__(self, launcher: Launcher, forget_manifest: Callable[[], None]) -> None:
        super().__init__(launcher, forget_manifest)
        self._lock = threading.RLock()  # interruption.md, rule 12
        self._owner = OwnerProcess()
        self._first: LoadedJail | None = None
        self._users: weakref.WeakSet[LoadedJail] = weakref.WeakSet()

    def provide(self, loaded: LoadedJail) -> None:
        """Start with a jail that is loaded already."""
        self._first = loaded
        # interruption.md, rule 13; it may never be taken, nor closed
        weakref.finalize(self, self.launcher.close, loaded).atexit = False

    def take(self, deadline: Deadline) -> LoadedJail:
        """A connection to the jail, which is opened if there is none."""
        with self._lock:
            if self._first is None:
                self._first = self.launcher.open(deadline)
            connected = self.launcher.connect(self._first, deadline)
            self._users.add(connected)
            return connected

    def end(self, loaded: LoadedJail) -> None:
        """End the jail, for all environments."""
        self.launcher.interrupt(loaded)
        with self._lock:
            if self._first is not None and self._first.jail.number == loaded.jail.number:
                self._close_first()

    def give_back(self, loaded: LoadedJail, *, wait: bool = True) -> None:
        """Drop a connection; with the last one the jail ends."""
        self.launcher.disconnect(loaded)
        loaded.jail.watched.forget()  # a lost reply may have named changed attributes
        with self._lock:
            self._users.discard(loaded)
            if not self._users:
                self._close_first()

    def close(self) -> None:
        """End a jail that was provided and never taken. A fork of its owner does nothing."""
        if not self._owner.is_here:
            return
        with self._lock:
            if not self._users:
                self._close_first()

    def _close_first(self) -> None:
        first = self._first
        if first is not None:
            self.launcher.close(first)  # interruption.md, rule 7
            self._first = None
