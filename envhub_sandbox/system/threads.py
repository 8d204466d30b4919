"""Parallel calls in daemon threads, which nothing waits for; and starts that a limit refuses."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from time import monotonic
from typing import Generic, TypeVar, cast

from envhub_sandbox.errors import WorkerStartupError

T = TypeVar("T")
_AT_ONCE = 64
_LOOK_S = 1.0


@contextlib.contextmanager
def starting(what: str) -> Iterator[None]:
    """Start threads or a process in it, and nothing else.
    Raises ``WorkerStartupError``: a limit does not let this process start any.
    """
    try:
        yield
    except (RuntimeError, BlockingIOError) as error:
        raise WorkerStartupError(
            f"this process cannot start {what}: raise the limit on processes and threads "
            "(ulimit -u; of a service TasksMax=; of a container its pids)"
        ) from error


class Call(Generic[T]):
    """One of several calls.

    Attributes:
        done: Whether it has returned or raised.
        value: Its result; None before it has returned, or if it raised.
        error: The exception that it raised, or None.
    """

    def __init__(self, call: Callable[[], T], finished: queue.SimpleQueue[None]) -> None:
        self.done = False
        self.value: T | None = None
        self.error: Exception | None = None
        self._call, self._finished = call, finished

    def result(self) -> T:
        """Return its result or raise its exception, once it is done."""
        if self.error is not None:
            raise self.error
        return cast("T", self.value)

    def run(self) -> None:
        """Make the call, in a thread, and keep its result."""
        try:
            self.value = self._call()
        except Exception as error:
            self.error = error
        finally:
            self.done = True
            self._finished.put(None)


class Calls(Generic[T]):
    """Runs calls in daemon threads, at most ``at_once`` at a time.
    ``each``: the calls, in their order.
    Raises ``RuntimeError``: no thread can be started. After that, and after an interrupt, calls
    that have begun continue, and no other begins.
    """

    def __init__(self, calls: Sequence[Callable[[], T]], at_once: int = _AT_ONCE) -> None:
        self._finished: queue.SimpleQueue[None] = queue.SimpleQueue()
        self.each = [Call(call, self._finished) for call in calls]
        self._left = deque(self.each)
        try:
            for _ in self.each[:at_once]:
                threading.Thread(target=self._run, name="envhub-calls", daemon=True).start()
        except BaseException:
            self._left.clear()
            raise

    def _run(self) -> None:
        """Run calls until none is left, in each thread."""
        with contextlib.suppress(IndexError):  # nothing is left
            while True:
                self._left.popleft().run()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until all calls are done, or for ``timeout_s``; returns whether all are done."""
        until = None if timeout_s is None else monotonic() + timeout_s
        while not all(call.done for call in self.each):
            left_s = _LOOK_S if until is None else min(_LOOK_S, until - monotonic())
            if left_s <= 0:
                return False
            try:
                self._finished.get(timeout=left_s)
            except queue.Empty:
                continue
        return True

    def results(self) -> list[T]:
        """The results of all calls. Raises the first exception without waiting for the others."""
        try:
            return [self._result(call) for call in self.each]
        finally:
            self._left.clear()

    def _result(self, call: Call[T]) -> T:
        while not call.done:
            with contextlib.suppress(queue.Empty):
                self._finished.get(timeout=_LOOK_S)
        return call.result()
