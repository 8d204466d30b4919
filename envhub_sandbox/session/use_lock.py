"""The lock that lets one thread at a time use an environment. ``close`` never waits for it.

A thread holds the lock from before a request is sent until its replies are handled:
docs/internals/interruption.md, rules 10 to 12.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager

from envhub_sandbox.errors import RemoteProtocolError, WorkerDiedError
from envhub_sandbox.session.failures import Failures
from envhub_sandbox.session.lease import Lease, closed_during
from envhub_worker.protocol.errors import blamed, is_fault
from envhub_worker.protocol.lifecycle import State

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


class UseLock:
    """The lock of one environment; its holder completes a ``close`` that came meanwhile.
    ``lock``: held during a use. Reentrant, since a signal handler may close the environment that
    its own thread is using.
    ``flight``: held in ``send``, ``recv`` and ``reset``, and taken before ``lock``, since a
    ``recv`` holds only the locks of workers that owe answers.
    """

    def __init__(self, lease: Lease, failures: Failures) -> None:
        self.lock = threading.RLock()  # interruption.md, rule 12
        self.flight = threading.RLock()
        self._lease = lease
        self._failures = failures

    @contextmanager
    def hold(self, operation: str) -> Iterator[None]:
        """Hold the lock. If ``close`` was called meanwhile, which does not wait, complete it."""
        with self.lock, self._lease.repository.named():
            try:
                yield
            except BaseException as error:
                if self._lease.lifecycle.closed:  # meanwhile, of which the error says nothing
                    self._lease.let_go()
                    if isinstance(error, Exception) and not isinstance(error, WorkerDiedError):
                        raise closed_during(operation) from error
                raise
            if self._lease.lifecycle.state is State.CLOSED:
                self._lease.let_go()

    @contextmanager
    def judging(self, operation: str) -> Iterator[None]:
        """Hold the lock while replies are handled.
        Raises ``RemoteProtocolError``: a reply violates the protocol; the environment is DEAD.
        """
        with self.hold(operation):
            try:
                yield
            except Exception as error:
                # in any other state the error was handled already, or ended a wait
                if self._lease.lifecycle.state is State.READY:
                    if is_fault(error):
                        broken = blamed(error)
                        self._failures.dead(broken)
                        raise broken from error
                    if isinstance(error, RemoteProtocolError):
                        self._failures.dead(error)
                raise

    def abandon(self) -> None:
        """In a fork, replace the locks, whose holder does not exist: interruption.md, rule 14."""
        self.lock = threading.RLock()
        self.flight = threading.RLock()


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
