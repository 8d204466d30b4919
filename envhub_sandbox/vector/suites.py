"""The result of ``make_env``, ``{suite: {task_id: VectorEnv}}``, and a map over its tasks."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from types import TracebackType
from typing import Any, Generic, TypeVar

from gymnasium.vector import VectorEnv

from envhub_sandbox.session.repository import Recipe
from envhub_sandbox.settings.options import option_name
from envhub_sandbox.system.log import WORKER, progress_shown
from envhub_sandbox.vector.vector_env import SandboxVectorEnv, leave_suite, serve_lerobot
from envhub_worker.protocol.text import parse_size, size_text

T = TypeVar("T")
Play = Callable[[str, Any, Any], T]
"""A caller's function of the suite, the task and the task's environment."""
Envs = Mapping[str, Mapping[int | str, VectorEnv[Any, Any, Any]]]


class Tasks(dict[Any, Any]):
    """The environments of one suite, by task id; a KeyError lists the ids that exist."""

    def __init__(self, suite: str, tasks: Mapping[Any, Any]) -> None:
        super().__init__(tasks)
        self._suite = suite

    def __missing__(self, task: object) -> Any:
        raise KeyError(
            f"{self._suite!r} has no task {task!r}; there are: {', '.join(map(repr, self))}"
        )


class EnvSuites(dict[str, dict[Any, VectorEnv[Any, Any, Any]]]):
    """A real ``dict`` of suites, each a ``dict`` of vector environments by task id.

    Usable as a context manager, which closes all of them.

    Args:
        envs: The environments.
        provenance: Makes ``provenance``.
        on_close: Runs after the environments have been closed.
        recipe: Makes the environments again; a pickle contains it, and so starts new workers.
    """

    def __init__(
        self,
        envs: Envs,
        provenance: Callable[[], dict[str, Any]],
        on_close: Callable[[], None] = lambda: None,
        recipe: Recipe | None = None,
    ) -> None:
        super().__init__({suite: Tasks(suite, tasks) for suite, tasks in envs.items()})
        self._provenance = provenance
        self._on_close = on_close
        self._recipe = recipe
        self._serves_lerobot = False

    def __missing__(self, suite: str) -> Any:
        raise KeyError(f"there is no suite {suite!r}; there are: {', '.join(map(repr, self))}")

    def __reduce__(self) -> tuple[Any, ...]:
        if self._recipe is None:
            raise TypeError("environments that run in this process cannot be pickled")
        if self._serves_lerobot:
            return _again_for_lerobot, (self._recipe,)
        return self._recipe.make, ()

    @property
    def env(self) -> Any:
        """The only environment of a repository that has one.

        Raises:
            ValueError: There are several; the text names them.
        """
        return choose(self)

    @property
    def reference(self) -> str | None:
        """A reference with the commit, which makes the same again. None for ``sandbox=None``."""
        return None if self._recipe is None else self._recipe.reference

    @property
    def provenance(self) -> dict[str, Any]:
        """The run's commit, file hashes, interpreter, packages, installed packages and layers."""
        return self._provenance()

    def map(
        self,
        play: Callable[[str, Any, Any], T],
        *,
        max_live_tasks: int | None = None,
        memory: int | str | None = None,
    ) -> dict[str, dict[Any, T]]:
        """Play every task, several at a time within a budget, and close each task afterwards.

        If there are more tasks than may have processes at a time, one of those with processes is
        the next task, which starts while the others are played. Progress is shown on a terminal and
        in a notebook.

        Args:
            play: Called with the suite, the task and its environment, in several threads at a time.
            max_live_tasks: How many tasks may have processes at the same time.
            memory: The bytes that the memory limits of all tasks with processes may add up to, or a
                text such as ``"16G"``. A task has ``limits["memory_bytes"]`` for each jail.

        Returns:
            The results of ``play``, by suite and task.

        Raises:
            ValueError: Neither bound is given, or not one task fits.
            Exception: The first exception of ``play``. The running tasks have ended, no other task
                was started, and all environments are closed.
        """
        sizes = [env.sandbox.memory_limit() for env in _sandboxed(self)]
        live = live_tasks(memory, max_live_tasks, max(sizes, default=0))
        for env in _sandboxed(self):
            leave_suite(env)
        return TaskMap(self, play, live).run()

    def _repr_html_(self) -> str:
        from envhub_sandbox.vector.html_repr import suites_html

        return suites_html(self)

    def close(self) -> None:
        """Close every environment and end its processes. Idempotent."""
        with contextlib.ExitStack() as stack:  # interruption.md, rule 9
            stack.callback(self._on_close)
            for env in _each(self)[::-1]:
                stack.callback(env.close)

    def __enter__(self) -> EnvSuites:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


def _each(suites: Envs) -> list[VectorEnv[Any, Any, Any]]:
    return [env for tasks in suites.values() for env in tasks.values()]


def _sandboxed(suites: Envs) -> list[SandboxVectorEnv]:
    return [env for env in _each(suites) if isinstance(env, SandboxVectorEnv)]


@contextlib.contextmanager
def closed_if_it_fails(suites: EnvSuites) -> Iterator[EnvSuites]:
    """Close the environments if the body of this context raises."""
    try:
        yield suites
    except BaseException:
        suites.close()
        raise


def for_lerobot(suites: EnvSuites) -> EnvSuites:
    """Prepare the environments for LeRobot's programs (``serve_lerobot``), and return them."""
    for env in _sandboxed(suites):
        serve_lerobot(env)
    suites._serves_lerobot = True
    return suites


def _again_for_lerobot(recipe: Recipe) -> EnvSuites:
    return for_lerobot(recipe.make())


def choose(
    suites: EnvSuites, suite: str | None = None, task: int | str | None = None
) -> VectorEnv[Any, Any, Any]:
    """The only environment of this suite and task; None for any suite or any task.
    Raises ``ValueError``: there is not exactly one; the text lists the existing ones.
    """
    chosen = _named(suites, suite, (task,))
    if len(chosen) == 1:
        return suites[chosen[0][0]][chosen[0][1]]
    if chosen:
        many = f"there are {len(chosen)} environments"
        raise ValueError(f"{many}; choose one by suite and task: {_names(chosen)}")
    available = _names(_named(suites))
    named = [("suite", suite), ("task", task)]
    wanted = " with a ".join(f"{word} {name!r}" for word, name in named if name is not None)
    raise ValueError(f"there is no {wanted}; there are: {available}")


def keep_only(suites: EnvSuites, suite: str | None = None, task: int | str | None = None) -> None:
    """Close and drop all environments but this suite's and task's; the task may be a text.
    Raises ``ValueError``: nothing would be left; the text lists the existing ones.
    """
    ids = [task_id for _, task_id in _named(suites, suite) if task in (task_id, str(task_id))]
    chosen = _named(suites, suite, (task, *ids))
    if not chosen:
        choose(suites, suite, task)
    for a_suite, tasks in list(suites.items()):
        for a_task in [task_id for task_id in tasks if (a_suite, task_id) not in chosen]:
            tasks.pop(a_task).close()
        if not tasks:
            del suites[a_suite]


def _named(
    suites: EnvSuites, suite: str | None = None, tasks: tuple[int | str | None, ...] = (None,)
) -> list[tuple[str, int | str]]:
    """The suite and task of each environment in this suite (None: any) with one of these tasks."""
    named = [(name, task) for name in suites for task in suites[name] if suite in (None, name)]
    return named if None in tasks else [pair for pair in named if pair[1] in tasks]


def _names(tasks: list[tuple[str, int | str]]) -> str:
    return ", ".join(f"[{suite!r}][{task!r}]" for suite, task in tasks)


# --- many tasks at once, within a budget --------------------------------------------------------


def live_tasks(memory: int | str | None, max_live_tasks: int | None, each_bytes: int) -> int:
    """How many tasks of ``each_bytes`` may have processes at a time: see ``EnvSuites.map``.
    Raises ``ValueError``: there is no bound, or not even one task fits.
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
    """Plays tasks so that at most ``live`` of them have processes at any time.

    One of these is started ahead of its turn; the others are played, each in a thread.
    """

    def __init__(self, suites: Mapping[str, Mapping[Any, Any]], play: Play[T], live: int) -> None:
        tasks = [(suite, task) for suite, tasks in suites.items() for task in tasks]
        self._suites = suites
        self._play = play
        self._total = len(tasks)
        self._left = deque(tasks)
        self._ahead = 1 < live < len(tasks)  # whether one of the live tasks is only started
        self._threads = min(len(tasks), live - self._ahead)
        self._lock = threading.RLock()  # interruption.md, rule 12
        self._failure: BaseException | None = None  # the first; no further task begins
        self._results: dict[tuple[str, Any], T] = {}

    def run(self) -> dict[str, dict[Any, T]]:
        """Play all tasks; returns the results by suite and task, or raises the first failure."""
        with progress_shown("tasks", WORKER) as tell:
            self._tell = tell
            try:
                from envhub_sandbox.system.threads import Calls  # which few need

                Calls([self._run] * self._threads).wait()
            except BaseException as error:  # a Ctrl-C: requests in other threads end with a close
                self._failure = error
        if self._failure is not None:
            with contextlib.ExitStack() as stack:  # interruption.md, rule 9
                for env in _each(self._suites):
                    stack.callback(env.close)
            raise self._failure
        return {
            suite: {task: self._results[suite, task] for task in tasks}
            for suite, tasks in self._suites.items()
        }

    def _run(self) -> None:
        """Play tasks until none is left or one has failed; runs in each thread."""
        try:
            while (next_task := self._next()) is not None:
                suite, task = next_task
                env = self._suites[suite][task]
                result = self._play(suite, task, env)
                env.close()
                with self._lock:
                    self._results[next_task] = result
                    self._tell(f"{len(self._results)} of {self._total} done, last {suite} {task}")
        except BaseException as error:
            with self._lock:
                self._failure = self._failure or error

    def _next(self) -> tuple[str, Any] | None:
        with self._lock:
            if self._failure is not None or not self._left:
                return None
            next_task = self._left.popleft()
            if self._ahead and self._left:
                suite, task = self._left[0]
                following = self._suites[suite][task]
                if hasattr(following, "prewarm"):  # an environment of this process has none
                    following.prewarm()
            return next_task
