"""A progress bar of a command, on stderr, where that is a terminal."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from typing import TYPE_CHECKING

from envhub_sandbox.cli.shared.console import console, safe_line, say
from envhub_sandbox.system.progress import progress_shown_by
from envhub_worker.protocol.text import duration_text

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from envhub_sandbox.check.play.episodes import EpisodeCounter

_EVERY_S = 0.1


class _LongWaits:
    """Prints what takes so many seconds, where no terminal shows it; again after twice as many."""

    def __init__(self, long_s: float) -> None:
        self._long_s = long_s
        self._what, self._begun, self._next = "", time.monotonic(), long_s
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="envhub-progress", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def begin(self, what: str) -> None:
        self._what, self._begun, self._next = what, time.monotonic(), self._long_s

    def stop(self) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(self._long_s / 10):
            spent = time.monotonic() - self._begun
            if self._what and spent >= self._next:
                self._next *= 2
                say(f"{safe_line(self._what)}: {duration_text(round(spent))} so far", "dim")


class ProgressBar:
    """A progress bar; shows nothing if stderr is no terminal. A context manager.

    Args:
        quiet: Show nothing at all.
        long_s: If stderr is no terminal, print a line about what takes so long; 0 prints none.
    """

    def __init__(self, *, quiet: bool, long_s: float = 0.0) -> None:
        terminal = sys.stderr.isatty()
        self._progress = None if quiet or not terminal else _progress()
        self._waits = _LongWaits(long_s) if long_s and not terminal else None
        self._task: TaskID | None = None
        self._total = 0
        self._begun = self._shown = time.monotonic()
        self._also = contextlib.ExitStack()

    def begin(self, title: str, total: int | None = None) -> None:
        """Show what begins; ``total`` in episodes, None where that is unknown."""
        self._total = total or 0
        self._begun = self._shown = time.monotonic()
        if self._waits is not None:
            self._waits.begin(title)
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

    def __enter__(self) -> ProgressBar:
        if self._progress is not None:
            self._progress.start()
        if self._waits is not None:
            self._waits.start()
        self._also.enter_context(progress_shown_by(self.begin))
        return self

    def __exit__(self, *_: object) -> None:
        self._also.close()
        if self._waits is not None:
            self._waits.stop()
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
