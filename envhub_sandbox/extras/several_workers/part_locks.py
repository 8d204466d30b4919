"""The locks of an environment over several workers: interruption.md, rules 10 and 16."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager

from envhub_sandbox.session.use_lock import UseLock

_AT_ONCE = 8
"""The number of locks that one ``with`` takes."""


@contextmanager
def all_held(locks: Sequence[threading.RLock]) -> Iterator[None]:
    """Hold several locks, taken in their order.

    A ``with`` statement takes and notes a lock without room for a Ctrl-C in between. So ``with``
    statements take all locks, eight at a time, in a tree that keeps the nesting low.
    """
    if len(locks) > _AT_ONCE:
        middle = len(locks) // 2
        with all_held(locks[:middle]), all_held(locks[middle:]):
            yield
        return
    spare = threading.RLock()
    a, b, c, d, e, f, g, h = (*locks, *[spare] * (_AT_ONCE - len(locks)))
    with a, b, c, d, e, f, g, h:
        yield


class FleetUse:
    """The lock of an environment over several workers: the locks of all parts."""

    def __init__(self, parts: Sequence[UseLock]) -> None:
        self._parts = parts
        self._holder: int | None = None  # the thread that holds the locks

    @property
    def lock(self) -> AbstractContextManager[None]:
        """The locks of all parts, in their order, for one ``with``: interruption.md, rule 16.

        After a Ctrl-C, they are released at the latest when this object goes.
        """
        return self.hold([part.lock for part in self._parts])

    @property
    def flight(self) -> threading.RLock:
        """The first part's ``flight``, which a fork replaces; see ``UseLock``."""
        return self._parts[0].flight

    @property
    def is_mine(self) -> bool:
        """Whether this thread holds the locks."""
        return self._holder == threading.get_ident()

    @contextmanager
    def hold(self, locks: Sequence[threading.RLock]) -> Iterator[None]:
        """Hold some of the parts' locks."""
        with all_held(locks):
            before, self._holder = self._holder, threading.get_ident()
            try:
                yield
            finally:
                self._holder = before
