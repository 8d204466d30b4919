"""Servers that nobody uses, kept for a while: who closes one environment often opens another.

One thread ends them when their time has come. It is there only while one of them has such a time,
and is a daemon: nothing waits for it at the end of this process, which ends them all at once.
"""

from __future__ import annotations

import contextlib
import os
import threading
import weakref
from collections.abc import Hashable
from dataclasses import dataclass
from time import monotonic
from typing import Any, Generic, Protocol, TypeVar

_LONGEST_WAIT_S = 3600.0


class Idle(Protocol):
    """What lingers.

    Attributes:
        runs: Whether it is still there.
    """

    @property
    def runs(self) -> bool: ...  # noqa: D102

    def stop(self) -> None:
        """End it, in bounded time, and once. A fork of its owner does nothing."""


S = TypeVar("S", bound=Idle)


@dataclass(eq=False)
class _Entry(Generic[S]):
    """One that lingers: whose it was, whose process it belongs to, and until when."""

    key: Hashable
    shared: S
    until: float | None
    owner: int


class Lingering(Generic[S]):
    """Keeps the last that was given up, each for a time of its own. Thread-safe.

    One at most: with a further one, the time of the one before has come. A fork has none: what its
    parent left lingering stays the parent's.
    """

    def __init__(self) -> None:
        # interruption.md, rule 12
        self._changed = threading.Condition(threading.RLock())
        self._entries: list[_Entry[S]] = []
        self._thread: threading.Thread | None = None
        self._refuses = False
        _all.add(self)

    def put(self, key: Hashable, shared: S, idle_s: float | None) -> bool:
        """Keep it for ``idle_s`` seconds, or None: until this process ends.

        Returns:
            False if it is not kept, since this process is about to end.
        """
        until = None if idle_s is None else monotonic() + idle_s
        with self._changed:
            if self._refuses:
                return False
            here = None
            for entry in self._mine():
                if entry.shared is shared:  # whoever gave it up was interrupted, and does so again
                    here = entry
                else:
                    entry.until = 0.0
            if here is None:
                self._entries.append(_Entry(key, shared, until, os.getpid()))
            else:
                here.until = until
            self._watch()
        return True

    def take(self, key: Hashable) -> S | None:
        """The one with this key, if it lingers and still runs. It is the caller's from here on.

        For one that has died its time has come: whoever ends it waits until nothing of it is left.
        """
        with self._changed:
            for entry in self._mine():
                if entry.key != key:
                    continue
                if entry.shared.runs:
                    self._entries.remove(entry)
                    self._changed.notify_all()
                    return entry.shared
                entry.until = 0.0
                self._watch()
        return None

    def stop_all(self, *, for_good: bool = False) -> None:
        """End those of this process now, and wait for those that are ending.

        Args:
            for_good: Keep none from now on.
        """
        with self._changed:
            self._refuses |= for_good
            mine, thread = self._mine(), self._thread
            for entry in mine:
                self._entries.remove(entry)
            self._changed.notify_all()
        with contextlib.ExitStack() as stack:  # whatever interrupts one end, the others follow
            if thread is not None and thread is not threading.current_thread():
                stack.callback(thread.join)
            for entry in mine:
                stack.callback(entry.shared.stop)

    def forked(self) -> None:
        """In a fork: whichever thread held the lock is not here, nor is the one that waits."""
        self._changed = threading.Condition(threading.RLock())
        self._thread = None

    def _mine(self) -> list[_Entry[S]]:
        return [entry for entry in self._entries if entry.owner == os.getpid()]

    def _watch(self) -> None:
        """See to it that somebody waits for the earliest end. The lock is held."""
        self._changed.notify_all()
        if self._thread is None and self._earliest() is not None:
            self._thread = threading.Thread(target=self._run, name="envhub-idle", daemon=True)
            self._thread.start()

    def _earliest(self) -> tuple[float, _Entry[S]] | None:
        timed = [(entry.until, entry) for entry in self._mine() if entry.until is not None]
        return min(timed, key=lambda one: one[0], default=None)

    def _run(self) -> None:
        while (shared := self._due()) is not None:
            try:
                shared.stop()
            except BaseException:
                with self._changed:
                    self._thread = None  # the next one gets a thread of its own
                raise

    def _due(self) -> S | None:
        """The next whose time has come; None, and the end of the thread, once there is none."""
        with self._changed:
            while (earliest := self._earliest()) is not None:
                until, entry = earliest
                left = until - monotonic()
                if left <= 0:
                    self._entries.remove(entry)
                    return entry.shared
                self._changed.wait(min(left, _LONGEST_WAIT_S))
            self._thread = None
            return None


_all: weakref.WeakSet[Lingering[Any]] = weakref.WeakSet()


def stop_idle(*, for_good: bool = False) -> None:
    """End whatever lingers in this process, of every kind."""
    with contextlib.ExitStack() as stack:
        for lingering in list(_all):
            stack.callback(lingering.stop_all, for_good=for_good)


def _forked() -> None:
    for lingering in list(_all):
        lingering.forked()


os.register_at_fork(after_in_child=_forked)
