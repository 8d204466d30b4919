"""The lock that lets one thread at a time use an environment. ``close`` never waits for it.

A thread holds the lock from before a request is sent until its replies are handled:
docs/internals/interruption.md, rules 10 to 12.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Protocol

from envhub_sandbox.errors import RemoteProtocolError, WorkerDiedError
from envhub_sandbox.session.failures import Failures
from envhub_sandbox.session.lease import Lease, closed_during
from envhub_worker.protocol.errors import blamed, is_fault
from envhub_worker.protocol.lifecycle import State


class Use(Protocol):
    """A ``UseLock``, or the locks of several workers."""

    @property
    def lock(self) -> AbstractContextManager[Any]:
        """Held during a use."""

    @property
    def flight(self) -> threading.RLock:
        """Held in ``send``, ``recv`` and ``reset``, and taken before ``lock``."""


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
