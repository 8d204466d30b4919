"""What is going on, on stderr, while a terminal looks."""

from __future__ import annotations

import contextlib
import sys
import time
from types import TracebackType
from typing import TYPE_CHECKING

from envhub_sandbox.cli.shared.console import console, safe_line
from envhub_sandbox.dependencies.progress import shown_by

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from envhub_sandbox.rollouts.episodes import EpisodeCounter

_EVERY_S = 0.1


class Bar:
    """A progress bar; shows nothing if stderr is no terminal. A context manager.

    Args:
        quiet: Show nothing at all.
    """

    def __init__(self, *, quiet: bool) -> None:
        self._progress = None if quiet or not sys.stderr.isatty() else _progress()
        self._task: TaskID | None = None
        self._total = 0
        self._begun = self._shown = time.monotonic()
        self._also = contextlib.ExitStack()

    def begin(self, title: str, total: int | None = None) -> None:
        """Show what begins; ``total`` in episodes, None where nobody knows how long."""
        self._total = total or 0
        self._begun = self._shown = time.monotonic()
        if self._progress is None:
            return
        if self._task is not None:
            self._progress.remove_task(self._task)
        self._task = self._progress.add_task(safe_line(title, 60), total=total, detail="")

    def update(self, counter: EpisodeCounter) -> None:
        """Show how far it is; often called, seldom drawn."""
        now = time.monotonic()
        if self._progress is None or self._task is None or now - self._shown < _EVERY_S:
            return
        self._shown = now
        speed = counter.steps / (now - self._begun)
        done = len(counter.counted)
        detail = f"{done}/{self._total} episodes, {counter.steps} steps, {speed:,.0f} steps/s"
        self._progress.update(self._task, completed=done, detail=detail)

    def __enter__(self) -> Bar:
        if self._progress is not None:
            self._progress.start()
        self._also.enter_context(shown_by(self.begin))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._also.close()
        if self._progress is not None:
            self._progress.stop()


def _progress() -> Progress:
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[detail]}", markup=False),
        TimeElapsedColumn(),
        console=console(stderr=True),
        transient=True,
    )
