"""Many tasks at once within a budget: ``EnvSuites.map``."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Generic, TypeVar

from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system.log import WORKER, progress_shown
from envhub_sandbox.system.threads import Calls
from envhub_worker.protocol.text import parse_size, size_text

T = TypeVar("T")
Play = Callable[[str, Any, Any], T]
"""Called with the suite, the task and its environment."""


def live_tasks(memory: int | str | None, max_live_tasks: int | None, each_bytes: int) -> int:
    """How many tasks may have processes at once.

    Args:
        memory: Bytes for all of them, or a text such as ``"16G"``.
        max_live_tasks: The most, whatever they take.
        each_bytes: What one may take.

    Raises:
        ValueError: Neither is given, or not even one task fits.
    """
    if memory is None and max_live_tasks is None:
        raise ValueError("map() takes max_live_tasks=, memory=, or both")
    if max_live_tasks is not None and max_live_tasks < 1:
        raise ValueError(f"max_live_tasks is {max_live_tasks}, and must be at least 1")
    if memory is None:
        assert max_live_tasks is not None
        return max_live_tasks
    whole = parse_size(memory) if isinstance(memory, str) else memory
    if not 0 < each_bytes <= whole:
        raise ValueError(
            f"memory is {memory!r}, and one task may take {size_text(each_bytes)}: give more, or "
            f"lower its limit with {option_name('limits', {'memory_bytes': 2**30})} for make_env"
        )
    fit = whole // each_bytes
    return fit if max_live_tasks is None else min(fit, max_live_tasks)


class TaskMap(Generic[T]):
    """Plays tasks, of which at most ``live`` have processes at any time.

    One of these is started ahead of its turn; the others are being played, each in a thread.
    """

    def __init__(self, suites: Mapping[str, Mapping[Any, Any]], play: Play[T], live: int) -> None:
        tasks = [(suite, task) for suite, tasks in suites.items() for task in tasks]
        self._suites = suites
        self._play = play
        self._total = len(tasks)
        self._left = deque(tasks)
        self._ahead = 1 < live < len(tasks)
        self._threads = min(len(tasks), live - self._ahead)
        self._lock = threading.RLock()  # interruption.md, rule 12
        self._failure: BaseException | None = None
        self._results: dict[tuple[str, Any], T] = {}

    def run(self) -> dict[str, dict[Any, T]]:
        """What each returned, by suite and task; raises what the first one raised that failed."""
        with progress_shown("tasks", WORKER) as tell:
            self._tell = tell
            try:
                Calls([self._run] * self._threads).wait()
            except BaseException as error:  # a Ctrl-C: requests in other threads end with a close
                self._failure = error
                self._close_all()
                raise
        if self._failure is not None:
            self._close_all()
            raise self._failure
        return {
            suite: {task: self._results[suite, task] for task in tasks}
            for suite, tasks in self._suites.items()
        }

    def _run(self) -> None:
        """In each thread."""
        try:
            while (next_one := self._next()) is not None:
                suite, task = next_one
                env = self._suites[suite][task]
                result = self._play(suite, task, env)
                env.close()
                with self._lock:
                    self._results[next_one] = result
                    self._tell(f"{len(self._results)} of {self._total} done, last {suite} {task}")
        except BaseException as error:
            with self._lock:
                self._failure = self._failure or error

    def _next(self) -> tuple[str, Any] | None:
        with self._lock:
            if self._failure is not None or not self._left:
                return None
            found = self._left.popleft()
            if self._ahead and self._left:
                suite, task = self._left[0]
                following = self._suites[suite][task]
                if hasattr(following, "prewarm"):  # one of this process has nothing to start
                    following.prewarm()
            return found

    def _close_all(self) -> None:
        with contextlib.ExitStack() as all_of_them:  # interruption.md, rule 9
            for tasks in self._suites.values():
                for env in tasks.values():
                    all_of_them.callback(env.close)
