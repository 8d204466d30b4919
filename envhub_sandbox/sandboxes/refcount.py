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
        uses: Who uses it; noted here, and nobody at first.
        runs: Whether it is still there.
    """

    uses: Uses

    @property
    def runs(self) -> bool: ...  # noqa: D102

    def stop(self) -> None:
        """End it, in bounded time. A fork of its owner does nothing.

        Idempotent, and to be called again where it was interrupted.
        """


S = TypeVar("S", bound=Shared)


class Use(Generic[S]):
    """One use of what is shared, which ends once: given back, or when nobody has it any more.

    It can be given back again until that is done, and its own end does it too: interruption.md,
    rules 5 and 7.

    Attributes:
        shared: What is used.
        live: Whether it has not been given back.
        done: Whether nothing is left to do after that.
    """

    done = True  # until there is something

    def __init__(
        self, sharing: Sharing[S], key: tuple[int, Hashable], shared: S, idle_s: float | None
    ) -> None:
        self._sharing = sharing
        self.key = key
        self.shared = shared
        self.idle_s = idle_s
        self.live = True
        self.done = False
        shared.uses.add(self)  # from here on nobody may end it

    def release(self) -> None:
        """Give it back; the last one who does gives up what is shared, unless it has been ended.

        A fork of whoever took it does nothing: a thread that is not there may have held the lock.
        """
        if not self.done and self.key[0] == os.getpid():
            self._sharing.release(self)

    def __del__(self) -> None:
        self.release()


class Uses:
    """Who uses something: those that live, and no count. interruption.md, rule 8."""

    def __init__(self) -> None:
        self._refs: list[weakref.ref[Use[Any]]] = []

    def __len__(self) -> int:
        return len(self.living())

    def add(self, use: Use[Any]) -> None:
        """There is one more; those that have ended are forgotten."""
        self._refs = [*map(weakref.ref, self.living()), weakref.ref(use)]

    def living(self) -> list[Use[Any]]:
        """Those that have not been given back."""
        found = (ref() for ref in self._refs)
        return [use for use in found if use is not None and use.live]


class Sharing(Generic[S]):
    """Knows who uses what. Thread-safe; a fork starts its own.

    Args:
        lingering: Where what nobody uses is kept, if its last user asks for it.
    """

    def __init__(self, lingering: Lingering[S] | None = None) -> None:
        self._lingering = lingering
        # interruption.md, rule 12
        self._lock = threading.RLock()
        self._shared: dict[tuple[int, Hashable], S] = {}
        _all.add(self)

    def acquire(self, key: Hashable, start: Callable[[], S], idle_s: float | None = 0.0) -> Use[S]:
        """A use of the one with this key, be it in use or lingering; started if none runs.

        Args:
            key: Which.
            start: Starts it.
            idle_s: For how long it is kept for the next, if this use is the last; 0 ends it, None
                keeps it until the end of this process.
        """
        mine = os.getpid(), key
        with self._lock:
            shared = self._shared.get(mine)
            if shared is not None:
                use = Use(self, mine, shared, idle_s)
                # the garbage collector may just have closed the one environment that used it
                if self._shared.get(mine) is shared and shared.runs:
                    return use
                use.release()
            lingering = None if self._lingering is None else self._lingering.take(mine)
            shared = lingering or start()
            use = Use(self, mine, shared, idle_s)
            self._shared[mine] = shared
            return use

    def release(self, use: Use[S]) -> None:
        """Give it back, or go on with that where it was interrupted."""
        shared = use.shared
        with self._lock:
            use.live = False
            if use.done or shared.uses.living():
                use.done = True  # whoever is left sees to it
                return
            if self._shared.get(use.key) is shared:
                del self._shared[use.key]
            # what was done is done again without harm: it lingers once, and is ended once
            if self._kept(use.key, shared, use.idle_s):
                use.done = True
                return
        shared.stop()
        use.done = True

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
                for use in shared.uses.living():
                    use.live, use.done = False, True
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
