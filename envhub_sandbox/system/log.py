"""Reports on running work: our part of the ``logging`` tree, warnings, and progress lines.

The loggers are silent until the application configures them. ``envhub_sandbox.worker``
logs jails: opened, closed (DEBUG), died, timed out, restarted (INFO).
``envhub_sandbox.worker.output`` has every line that they print (DEBUG). ``envhub_sandbox.snapshot``
logs downloads, ``envhub_sandbox.dependencies`` packages, ``envhub_sandbox.crashes``
crash bundles. ``envhub_sandbox.errors`` has the full tracebacks of errors, and
``envhub_sandbox.messages`` the names of messages to and from a server, without values (DEBUG).

Progress of slow work, such as making packages, is shown on a terminal or in a notebook. Elsewhere
(in CI, under a program) only the log has it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

ROOT = logging.getLogger("envhub_sandbox")
ROOT.addHandler(logging.NullHandler())
WORKER = ROOT.getChild("worker")
OUTPUT = WORKER.getChild("output")
SNAPSHOT = ROOT.getChild("snapshot")
DEPENDENCIES = ROOT.getChild("dependencies")
CRASHES = ROOT.getChild("crashes")
ERRORS = ROOT.getChild("errors")
MESSAGES = ROOT.getChild("messages")


def warn_caller(message: str | Warning, category: type[Warning] = UserWarning) -> None:
    """Warn at the line of the caller's own code: the first frame outside of this package."""
    frame, level = sys._getframe(), 1
    while frame.f_back is not None and _is_ours(frame.f_globals.get("__name__")):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


def _is_ours(name: object) -> bool:
    return isinstance(name, str) and name.partition(".")[0] == ROOT.name


_WIDTH = 100
_shown_by: list[Callable[[str], None]] = []
_told_by: list[Callable[[str], None]] = []


@contextlib.contextmanager
def progress_shown_by(show: Callable[[str], None]) -> Iterator[None]:
    """Within this context, pass progress lines to ``show``, which uses the terminal already."""
    _shown_by.append(show)
    try:
        yield
    finally:
        _shown_by.remove(show)


@contextlib.contextmanager
def told_by(show: Callable[[str], None]) -> Iterator[None]:
    """Within this context, pass lines of ``tell`` to ``show``, too, each line once."""
    names: set[str] = set()

    def once(line: str) -> None:
        if line not in names:
            names.add(line)
            show(line)

    _told_by.append(once)
    try:
        yield
    finally:
        _told_by.remove(once)


def tell(line: str, log: logging.Logger) -> None:
    """Log a line that users have to know, and show it."""
    log.info("%s", line)
    for show in _told_by[-1:]:
        show(line)


@contextlib.contextmanager
def progress_shown(
    title: str, log: logging.Logger = DEPENDENCIES
) -> Iterator[Callable[[str], None]]:
    """Yields a function that logs a line of progress, and shows it."""
    with contextlib.ExitStack() as stack:
        shows = list(_shown_by[-1:])
        console = None if shows else _console()
        if console is not None:
            from rich.text import Text

            status = stack.enter_context(console.status(""))
            shows = [lambda text: status.update(Text(text))]

        def tell(line: str) -> None:
            log.info("%s: %s", title, line)
            for show in shows:
                show(f"{title}: {line}"[:_WIDTH])

        yield tell


def _console() -> Console | None:
    """A console on stderr if a user sees it: on a terminal or in a notebook, not in CI."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    is_notebook = type(shell).__name__ == "ZMQInteractiveShell"
    looked_at = sys.stderr is not None and sys.stderr.isatty()
    if os.environ.get("CI") or not (looked_at or is_notebook):
        return None
    from rich.console import Console

    return Console(stderr=True, markup=False, highlight=False, emoji=False)
