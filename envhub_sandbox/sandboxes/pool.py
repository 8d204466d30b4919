"""The worker servers of this process: each starts for its first use and ends after its last.

If its last user asked for it, an unused server is kept for a while, because a caller who closes
one environment often opens another. ``ServerHold`` keeps a server for a whole suite.

Interrupts, finalizers, threads and forks may come between any two statements (interruption.md):

- A server is in use while one of its uses is live. It has no count, which a Ctrl-C could falsify
  (rule 8). If a use was noted nowhere, its finalizer gives it back (rule 5).
- Giving a use back clears ``live`` first and sets ``_done`` last. The steps between are repeatable,
  so ``release`` can be called until it completes (rule 7).
- The lock is reentrant: the garbage collector may close an environment in the middle of
  ``acquire``, and a signal handler in the middle of anything (rule 12).
- Servers are started and ended outside of the lock, so that callers with other servers do not wait.
  Each server has a lock for its start, for callers who want the same server.
- A fork sees its parent's servers under another pid, and does not touch them.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import threading
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial
from operator import itemgetter
from time import monotonic
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from envhub_sandbox.system.platform import OwnerProcess, each_after_fork

if TYPE_CHECKING:
    from envhub_sandbox.transport.connection import FarServer

_LONGEST_WAIT_S = 3600.0


class WorkerServer(ABC):
    """A running worker server.

    Attributes:
        process_fd: A descriptor that becomes readable when the server ends.
        fd_path: The socket that takes descriptors, or None if memory cannot be shared.
        layers: The layers that confine the server itself and all of its jails, a mapping for each:
            ``layer``, ``enforced``, ``detail``.
        silent_s: The time, by the monotonic clock, when it last did not answer the end of a jail.
        far: The keys of a server on another host, which sees no file of this one; else None.
        uploading: Held during an upload to a server on another host.
        is_ours: Whether this process started it, and will end it.
    """

    endpoint: str
    process_fd: int
    fd_path: str | None = None
    layers: Sequence[Mapping[str, Any]] = ()
    silent_s: float = float("-inf")
    far: FarServer | None = None
    uploading: threading.Lock
    is_ours = True

    @property
    @abstractmethod
    def runs(self) -> bool:
        """Whether the server runs and can be reached."""

    @abstractmethod
    def stop(self) -> None:
        """End the server and all of its jails, in bounded time. A fork of its owner does nothing.

        Idempotent. If interrupted, the next call finishes the work: interruption.md, rules 7, 14.
        """


S = TypeVar("S", bound=WorkerServer)
S_co = TypeVar("S_co", bound=WorkerServer, covariant=True)


class _Entry(Generic[S_co]):
    """A server, its uses, and how long to keep it after them (None: until this process ends)."""

    def __init__(self, key: Hashable, server: S_co) -> None:
        self.pid = os.getpid()
        self.key = key
        self.group: Hashable = None  # the users that share it now
        self.server = server
        self.until: float | None = None  # when to end it, while it is idle
        self._uses: list[weakref.ref[ServerUse[Any]]] = []

    def uses(self) -> list[ServerUse[Any]]:
        """The live uses, which were not given back."""
        live = (ref() for ref in self._uses)
        return [use for use in live if use is not None and use.live]

    def add(self, use: ServerUse[Any]) -> None:
        """Add a use, and forget those that have ended."""
        self._uses = [*map(weakref.ref, self.uses()), weakref.ref(use)]


class ServerUse(Generic[S_co]):
    """One use of a server. It ends when it is given back or collected as garbage.
    ``live``: whether the use was not given back yet.
    """

    _done = True  # until there is something to give back

    def __init__(self, pool: ServerPool[Any], entry: _Entry[S_co], idle_s: float | None) -> None:
        self._pool, self._entry, self._idle_s = pool, entry, idle_s
        self.server = entry.server
        self.live = True
        self._done = False
        entry.add(self)  # from here on the server may not be ended

    def users(self) -> int:
        """The number of uses of the server."""
        return len(self._entry.uses())

    def release(self) -> None:
        """Give the use back; the last use also gives up the server. Idempotent.

        After an interrupt, the next call finishes the work. A fork does nothing: a thread that
        does not exist there may hold the lock.
        """
        if not self._done and self._entry.pid == os.getpid():
            self._done = self._pool.give_back(self, self._entry, self._idle_s)

    def __del__(self) -> None:
        self.release()  # interruption.md, rule 5


_Place = tuple[int, Hashable, Hashable]
"""The pid, the key and the group."""


class ServerPool(Generic[S]):
    """The servers of one kind. Thread-safe; a fork starts its own.

    At most one unused server is kept: a further unused server ends the earlier one. A daemon thread
    ends idle servers in time, and exists only while some have a time; at the exit of the process
    all servers are ended at once.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition(threading.RLock())
        # a caller who wants a server that is starting waits for its lock: interruption.md, rule 12
        self._starts: weakref.WeakValueDictionary[_Place, threading.RLock]
        self._starts = weakref.WeakValueDictionary()
        self._used: dict[_Place, _Entry[S]] = {}  # servers with a use, or whose last one just ended
        self._idle: list[_Entry[S]] = []  # servers without a use, which ``_thread`` ends in time
        self._thread: threading.Thread | None = None
        self._ends = False  # at the exit: nothing is kept any more
        _pools.add(self)

    def acquire(
        self,
        key: Hashable,
        start: Callable[[], S],
        idle_s: float | None = 0.0,
        group: Hashable = None,
    ) -> ServerUse[S]:
        """Return a use of the server with this key; ``start`` starts the server if none runs.
        ``idle_s``: how long to keep the server if this is its last use; None: until this process
        ends.
        ``group``: the users who share the server; another group gets it only while it is unused.
        """
        # The lock of this start is held throughout, so a second caller waits and then finds the
        # entry. ``_changed`` is held only around the tables and never around ``start``, which takes
        # long. A use is made before the entry is judged or noted, so that no other thread ends the
        # server in between.
        slot = os.getpid(), key, group
        with self._changed:
            starting = self._starts.setdefault(slot, threading.RLock())
        with starting:
            with self._changed:
                entry = self._used.get(slot)
                if entry is not None:
                    use = ServerUse(self, entry, idle_s)
                    # the garbage collector may just have closed the last environment that used it
                    if self._used.get(slot) is entry and entry.server.runs:
                        return use
                    use.release()
                entry = self._take(key)
            entry = entry or _Entry(key, start())
            with self._changed:
                entry.group = group
                use = ServerUse(self, entry, idle_s)
                self._used[slot] = entry
                return use

    def give_back(self, use: ServerUse[S], entry: _Entry[S], idle_s: float | None) -> bool:
        """End a use, or complete an interrupted end; returns True. Only ``ServerUse`` calls it."""
        with self._changed:
            # In this order. The last of two threads that give uses back at once sees no live one,
            # and gives up the server. The entry leaves the table before its server ends: who asks
            # now gets a new one.
            use.live = False
            if entry.uses():
                return True  # the server stays until its last use ends
            slot = entry.pid, entry.key, entry.group
            if self._used.get(slot) is entry:
                del self._used[slot]
            if idle_s != 0 and not self._ends and entry.server.runs:
                for other in self._mine():
                    other.until = 0.0
                entry.until = None if idle_s is None else monotonic() + idle_s
                if entry not in self._idle:  # an interrupted release may have added it
                    self._idle.append(entry)
                if self._watch():
                    return True
                self._idle.remove(entry)
        entry.server.stop()
        return True

    # --- idle servers; the lock is held ----------------------------------------------------------

    def _take(self, key: Hashable) -> _Entry[S] | None:
        """Take an idle server with this key, or None; the thread ends one that has died."""
        for entry in self._mine():
            if entry.key == key:
                if entry.server.runs:
                    self._idle.remove(entry)
                    self._changed.notify_all()
                    return entry
                entry.until = 0.0
                self._watch()
        return None

    def _mine(self) -> list[_Entry[S]]:
        return [entry for entry in self._idle if entry.pid == os.getpid()]

    def _earliest(self) -> tuple[float, _Entry[S]] | None:
        timed = [(entry.until, entry) for entry in self._mine() if entry.until is not None]
        return min(timed, key=itemgetter(0), default=None)

    def _watch(self) -> bool:
        """Start the thread if it is needed; returns whether a limit on threads allows it."""
        self._changed.notify_all()
        if self._thread is None and self._earliest() is not None:
            thread = threading.Thread(target=self._run, name="envhub-idle", daemon=True)
            try:
                thread.start()
            except RuntimeError:
                return False
            # interruption.md, rule 4: noted after its start, so a Ctrl-C leaves none to be joined
            self._thread = thread
        return True

    # --- ending servers --------------------------------------------------------------------------

    def _run(self) -> None:
        while (server := self._due()) is not None:
            try:
                server.stop()
            except BaseException:
                with self._changed:
                    self._thread = None  # the next server gets a new thread
                raise

    def _due(self) -> S | None:
        """Wait until an idle server is to end, and return it; None ends the thread."""
        with self._changed:
            while (earliest := self._earliest()) is not None:
                until, entry = earliest
                left = until - monotonic()
                if left <= 0:
                    self._idle.remove(entry)
                    return entry.server
                self._changed.wait(min(left, _LONGEST_WAIT_S))
            self._thread = None
            return None

    def stop_idle(self) -> None:
        """End idle servers now, and wait for servers that are ending already."""
        self._stop(used=False)

    def stop_all(self) -> None:
        """End all servers of this process and keep none from now on; called at its exit."""
        self._ends = True
        self._stop(used=True)

    def _stop(self, *, used: bool) -> None:
        with self._changed:
            entries, thread = self._mine(), self._thread
            if used:
                entries += [e for e in self._used.values() if e.pid == os.getpid()]
            for entry in entries:
                for use in entry.uses():
                    use.live, use._done = False, True
            self._idle = [entry for entry in self._idle if entry not in entries]
            self._used = {p: entry for p, entry in self._used.items() if entry not in entries}
            self._changed.notify_all()
        with contextlib.ExitStack() as stack:  # interruption.md, rule 9
            if thread is not None and thread is not threading.current_thread():
                stack.callback(thread.join)
            for entry in entries:
                stack.callback(entry.server.stop)

    def forked(self) -> None:
        """In a fork, replace the parent's locks and thread: interruption.md, rule 14."""
        self._changed = threading.Condition(threading.RLock())
        self._starts.clear()
        self._thread = None


class ServerHold:
    """Keeps a server from the first jail until the last environment is closed. Thread-safe.

    An evaluation closes each task before it opens the next, and may compute in between for longer
    than an idle server is kept. It also need not wait for the end of each jail, which takes some
    20 ms because the kernel has to remove memory and mounts. So closing one environment of several
    only asks for the end of its jail; the next close waits for that end.
    ``on_enter``: called when an environment is added.
    ``on_empty``: called when the last environment is closed, and again after an interrupt.
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
        self._open: set[object] = set()  # a ticket for each environment
        self._use: ServerUse[Any] | None = None  # keeps the server
        self._left: list[ServerUse[Any]] = []  # uses to be released, outside of the lock
        # A list without the lock: other threads may append while one waits, and each takes its
        # waits out of the list.
        self._pending_closes: list[Callable[[], None]] = []

    def enter(self) -> Callable[[], None]:
        """Add an environment; returns an idempotent function that removes it."""
        ticket = object()
        with self._lock:
            self._on_enter()
            self._open.add(ticket)
        return partial(self._leave, ticket)

    def keep(self, used: WorkerServer) -> None:
        """Keep the server in which a jail is opened, while environments may need it again."""
        with self._lock:
            if not self._open or self._is_kept(used):
                return
            use = self._acquire()
            if self._use is not None:  # the server of this use has died
                self._left.append(self._use)
            self._use = use
        self._let_go()

    def close_later(self, server: WorkerServer, wait: Callable[[], None]) -> bool:
        """Leave the wait for the end of a jail to the next close; False if this is the last close.

        Waits for jails that were deferred earlier; most have ended by now.
        """
        with self._lock:
            if not self._is_kept(server) or len(self._open) <= 1:
                return False
        self.settle()
        self._pending_closes.append(wait)
        return True

    def settle(self) -> bool:
        """Wait for jails that are ending; returns whether there were any."""
        settled = False
        while self._pending_closes:
            try:
                wait = self._pending_closes.pop()
            except IndexError:  # another thread was faster
                break
            settled = True
            wait()
        return settled

    def _is_kept(self, server: WorkerServer) -> bool:
        use = self._use
        return use is not None and use.live and use.server is server

    def _leave(self, ticket: object) -> None:
        """Remove an environment; an interrupted call can be repeated: interruption.md, rule 7."""
        if not self._owner.is_here:
            return  # a fork: the server is the parent's, and the lock may be held for ever
        # Each step can be repeated: the use moves to ``_left`` under the lock, then deferred jails
        # end, then the uses in ``_left`` are released, and ``on_empty`` comes last.
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


_pools: weakref.WeakSet[ServerPool[Any]] = weakref.WeakSet()


def stop_idle() -> None:
    """End the unused servers of this process, in all pools."""
    with contextlib.ExitStack() as stack:  # interruption.md, rule 9
        for pool in list(_pools):
            stack.callback(pool.stop_idle)


def _stop_all() -> None:
    with contextlib.ExitStack() as stack:  # interruption.md, rule 9
        for pool in list(_pools):
            stack.callback(pool.stop_all)


atexit.register(_stop_all)
each_after_fork(_pools, ServerPool.forked)
