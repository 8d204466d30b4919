"""The ends of jails that nobody has waited for yet.

An evaluation closes each task before it opens the next, and a jail takes some 20 ms to end: its
processes die at once, but the kernel has to take their memory and their mounts away. So where
others of a suite are still open, whoever closes one only asks for it. That nothing is left is
waited for by whoever closes the next, and by the last.
"""

from __future__ import annotations

from collections.abc import Callable


class Partings:
    """What is still to be waited for. Thread-safe without a lock.

    A list is enough: what one thread has taken from it, no other waits for. See interruption.md,
    rule 12.
    """

    def __init__(self) -> None:
        self._waits: list[Callable[[], None]] = []

    def add(self, wait: Callable[[], None]) -> None:
        """Wait for those before this one, which have mostly come; this one is for later."""
        self.settle()
        self._waits.append(wait)

    def settle(self) -> bool:
        """Wait for all; whether there was one."""
        found = False
        while self._waits:
            try:
                wait = self._waits.pop()
            except IndexError:  # another thread was faster
                break
            found = True
            wait()
        return found
