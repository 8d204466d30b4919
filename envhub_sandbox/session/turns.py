"""Whose turn it is: one thread asks an environment something at a time, and none waits to close.

Who breaks that is found only after a collision: a note of the thread in each step would cost every
step, and the stacks of all threads are there anyway.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from gymnasium.error import AlreadyPendingCallError

from envhub_sandbox.errors import RemoteProtocolError, WorkerDiedError
from envhub_sandbox.session.lease import Lease
from envhub_sandbox.session.refusals import closed_during
from envhub_sandbox.session.survival.failures import Failures
from envhub_worker.protocol.lifecycle import State
from envhub_worker.protocol.untrusted import blamed, is_fault


class Turns:
    """The turns of one environment.

    Args:
        lease: Its jail, which is given back at the end of a turn that a ``close`` came into.
        failures: Tell of a worker that breaks the rules.

    Attributes:
        lock: Held for as long as a turn lasts; reentrant, for a signal handler may close what its
            own thread waits for.
    """

    def __init__(self, lease: Lease, failures: Failures) -> None:
        self.lock = threading.RLock()
        self._lease = lease
        self._failures = failures

    @contextmanager
    def take(self, operation: str) -> Iterator[None]:
        """Hold the lock. A ``close`` that has come when it is left, did not wait for it."""
        with self.lock, self._lease.repository.named():
            try:
                yield
            except BaseException as error:
                self._after_close(operation, error)
                raise
            if self._lease.lifecycle.state is State.CLOSED:
                self._lease.let_go()

    def _after_close(self, operation: str, error: BaseException) -> None:
        """What failed because of a ``close`` in its midst says so, and gives back what is left.

        Raises:
            WorkerDiedError: It was closed, and the error does not say so.
        """
        if not self._lease.lifecycle.closed:
            return
        self._lease.let_go()
        if isinstance(error, Exception) and not isinstance(error, WorkerDiedError):
            raise closed_during(operation) from error

    @contextmanager
    def judging(self, operation: str) -> Iterator[None]:
        """Take the turn to handle what came: who breaks a rule in it is given up.

        Raises:
            RemoteProtocolError: It did, whatever the handling raised; the environment is then DEAD.
        """
        with self.take(operation):
            try:
                yield
            except Exception as error:
                # in any other state somebody has dealt with it already, or interrupted a wait
                if self._lease.lifecycle.state is State.READY:
                    self._judge(error)
                raise

    def _judge(self, error: Exception) -> None:
        if is_fault(error):
            broken = blamed(error)
            self._failures.dead(broken)
            raise broken from error
        if isinstance(error, RemoteProtocolError):
            self._failures.dead(error)

    def abandon(self) -> None:
        """In a fork of the process that made it: whichever thread held the lock is not here."""
        self.lock = threading.RLock()


def collision(exchange: object, operation: str) -> AlreadyPendingCallError | None:
    """The error for a request in the midst of another thread's; None if no thread is at one."""
    own, names = threading.get_ident(), {one.ident: one.name for one in threading.enumerate()}
    for ident, frame in sys._current_frames().items():
        if ident != own and _uses(frame, exchange):
            return AlreadyPendingCallError(
                f"cannot {operation}: thread {names.get(ident, ident)!r} is using this environment "
                "at the same time, and it is for one thread at a time: hold a lock around its use, "
                "or make one for each thread",
                operation,
            )
    return None


def _uses(innermost: FrameType, exchange: object) -> bool:
    """Whether a method of it, or of what has it, is being executed."""
    frame: FrameType | None = innermost
    while frame is not None:
        name = frame.f_globals.get("__name__", "")
        if name.startswith(_OURS) and frame.f_code.co_name != "close":
            own = frame.f_locals.get("self")
            has = getattr(own, "__dict__", {})
            if own is exchange or exchange in (has.get("requests"), has.get("_requests")):
                return True
        frame = frame.f_back
    return False


_OURS = (
    *("envhub_sandbox.session.env_session", "envhub_sandbox.session.requests"),
    "envhub_sandbox.vector.",
)
