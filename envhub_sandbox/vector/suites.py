"""What ``make_env`` returns: ``{suite: {task_id: VectorEnv}}``, with ``close``, ``provenance``."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, TypeVar

from gymnasium.vector import VectorEnv

from envhub_sandbox.session.recipe import Recipe
from envhub_sandbox.vector.task_map import TaskMap, live_tasks
from envhub_sandbox.vector.vector_env import SandboxVectorEnv, leave_suite

T = TypeVar("T")
Envs = Mapping[str, Mapping[int | str, VectorEnv[Any, Any, Any]]]


class Tasks(dict[Any, Any]):
    """The environments of one suite, by task id; one that is not there is named with the others."""

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
        recipe: Makes them again: a pickle starts workers of its own.
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

    def __missing__(self, suite: str) -> Any:
        raise KeyError(f"there is no suite {suite!r}; there are: {', '.join(map(repr, self))}")

    def __reduce__(self) -> tuple[Any, ...]:
        if self._recipe is None:
            raise TypeError("environments that run in this process cannot be pickled")
        return self._recipe.make, ()

    @property
    def env(self) -> Any:
        """The environment of a repository that has just one.

        Raises:
            ValueError: There are several; the text names them.
        """
        return choose(self)

    @property
    def reference(self) -> str | None:
        """What makes the very same again: the commit is in it. None where code runs here."""
        return None if self._recipe is None else self._recipe.reference

    @property
    def provenance(self) -> dict[str, Any]:
        """What runs: commit, file hashes, interpreter, packages, what was installed, layers."""
        return self._provenance()

    def map(
        self,
        play: Callable[[str, Any, Any], T],
        *,
        max_live_tasks: int | None = None,
        memory: int | str | None = None,
    ) -> dict[str, dict[Any, T]]:
        """Play every task, several at a time within a budget, and close each after it was played.

        If there are more tasks than may live, one of the live tasks is the next one, which starts
        while the others are played. Progress is shown on a terminal and in a notebook.

        Args:
            play: Called with the suite, the task and its environment. Tasks that are played at the
                same time have a thread each.
            max_live_tasks: How many tasks may have processes at the same time.
            memory: Bytes that the limits of all live tasks may add up to, or a text such as
                ``"16G"``. A task takes ``limits["memory_bytes"]``, in a fleet for each worker.

        Returns:
            What ``play`` returned, by suite and task.

        Raises:
            ValueError: Neither bound is given, or not one task fits.
            Exception: The first that ``play`` raised. The tasks that were being played have ended,
                no other was started, and all are closed.
        """
        each = [env for tasks in self.values() for env in tasks.values()]
        sizes = [env.sandbox.memory_limit() for env in each if isinstance(env, SandboxVectorEnv)]
        live = live_tasks(memory, max_live_tasks, max(sizes, default=0))
        for env in each:
            if isinstance(env, SandboxVectorEnv):
                leave_suite(env)
        return TaskMap(self, play, live).run()

    def _repr_html_(self) -> str:
        from envhub_sandbox.vector.html_repr import suites_html

        return suites_html(self)

    def close(self) -> None:
        """Close every environment and end its processes. Idempotent."""
        with contextlib.ExitStack() as all_of_them:  # interruption.md, rule 9
            all_of_them.callback(self._on_close)
            for env in [env for tasks in self.values() for env in tasks.values()][::-1]:
                all_of_them.callback(env.close)

    def __enter__(self) -> EnvSuites:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


def choose(
    suites: EnvSuites, suite: str | None = None, task: int | str | None = None
) -> VectorEnv[Any, Any, Any]:
    """The one environment of this suite and this task; None is whichever there is.

    Raises:
        ValueError: There is not exactly one; the text names what there is.
    """
    found = _named(suites, suite, lambda one: task in (None, one))
    if len(found) == 1:
        return suites[found[0][0]][found[0][1]]
    if found:
        raise ValueError(f"there are {len(found)} environments; choose one: {_names(found)}")
    there = _names(_named(suites, None, lambda _: True))
    named = [("suite", suite), ("task", task)]
    wanted = " with a ".join(f"{word} {name!r}" for word, name in named if name is not None)
    raise ValueError(f"there is no {wanted}; there are: {there}")


def keep_only(suites: EnvSuites, suite: str | None = None, task: int | str | None = None) -> None:
    """Close and drop all but this suite and this task; a task is also found by its text.

    Raises:
        ValueError: Nothing would be left; the text names what there is.
    """
    chosen = _named(suites, suite, lambda one: task in (None, one, str(one)))
    if not chosen:
        choose(suites, suite, task)
    for a_suite, tasks in list(suites.items()):
        for a_task in [one for one in tasks if (a_suite, one) not in chosen]:
            tasks.pop(a_task).close()
        if not tasks:
            del suites[a_suite]


def _named(
    suites: EnvSuites, suite: str | None, is_meant: Callable[[int | str], bool]
) -> list[tuple[str, int | str]]:
    meant = [(name, tasks) for name, tasks in suites.items() if suite in (None, name)]
    return [(name, task) for name, tasks in meant for task in tasks if is_meant(task)]


def _names(found: list[tuple[str, int | str]]) -> str:
    return ", ".join(f"[{suite!r}][{task!r}]" for suite, task in found)
