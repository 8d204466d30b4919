"""What the environments of this process share: started for the first of them, given up by the last.

What is given up is ended, or kept for a while if its last user asked for that.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import threading
import weakref
from collections.abc import Callable, Hashable
from typing import Any, Generic, Protocol, TypeVar

from envhub_sandbox.sandboxes.lingering import Lingering, stop_idle


class Shared(Protocol):
    """A worker server, or what stands for one that is elsewhere.

    Attributes:
        users: How many use it; counted here, and 0 at first.
        runs: Whether it is still there.
    """

    users: int

    @property
    def runs(self) -> bool: ...  # noqa: D102

    def stop(self) -> None:
        """End it, in bounded time. A fork of its owner does nothing."""


S = TypeVar("S", bound=Shared)


class Sharing(Generic[S]):
    """Counts who uses what. Thread-safe; a fork starts its own.

    Args:
        lingering: Where what nobody uses is kept, if its last user asks for it.
    """

    def __init__(self, lingering: Lingering[S] | None = None) -> None:
        self._lingering = lingering
        # reentrant: the garbage collector may close an environment in the middle of acquire()
        self._lock = threading.RLock()
        self._shared: dict[tuple[int, Hashable], S] = {}
        _all.add(self)

    def acquire(self, key: Hashable, start: Callable[[], S]) -> S:
        """The one with this key, in use or lingering; started if there is none that runs."""
        mine = os.getpid(), key
        with self._lock:
            shared = self._shared.get(mine)
            if shared is not None:
                shared.users += 1  # at once: nobody may end it from here on
                try:
                    runs = shared.runs
                except BaseException:  # Ctrl-C, while it is looked at
                    self.release(shared)
                    raise
                if runs:
                    return shared
                self.release(shared)
            lingering = None if self._lingering is None else self._lingering.take(mine)
            shared = self._shared[mine] = lingering or start()
            shared.users += 1
            return shared

    def release(self, shared: S, idle_s: float | None = 0.0) -> None:
        """Give it back; the last one who does gives it up, unless it has been ended.

        Args:
            shared: What ``acquire`` gave.
            idle_s: For how long it is kept for the next; 0 ends it, None keeps it until the end
                of this process.
        """
        with self._lock:
            if not shared.users:
                return
            shared.users -= 1
            if shared.users > 0:
                return
            for key, known in list(self._shared.items()):
                if known is shared:
                    del self._shared[key]
                    if self._kept(key, shared, idle_s):
                        return
        shared.stop()

    def _kept(self, key: tuple[int, Hashable], shared: S, idle_s: float | None) -> bool:
        """Whether it lingers from here on; what is a parent's cannot."""
        if self._lingering is None or idle_s == 0 or key[0] != os.getpid() or not shared.runs:
            return False
        return self._lingering.put(key, shared, idle_s)

    def stop_all(self) -> None:
        """End all that this process has started, as at its exit."""
        with self._lock:
            mine = [key for key in self._shared if key[0] == os.getpid()]
            ended = [self._shared.pop(key) for key in mine]
            for shared in ended:
                shared.users = 0
        for shared in ended:
            shared.stop()

    def forked(self) -> None:
        """In a fork: whichever thread held the lock is not here."""
        self._lock = threading.RLock()


_all: weakref.WeakSet[Sharing[Any]] = weakref.WeakSet()


def _stop_all() -> None:
    with contextlib.ExitStack() as stack:  # whatever interrupts one of them, the others follow
        stack.callback(stop_idle, for_good=True)
        for sharing in list(_all):
            stack.callback(sharing.stop_all)


def _forked() -> None:
    for sharing in list(_all):
        sharing.forked()


atexit.register(_stop_all)
os.register_at_fork(after_in_child=_forked)
