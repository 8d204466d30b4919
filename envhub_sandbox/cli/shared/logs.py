"""What ``--verbose`` and ``--worker-output`` show on stderr."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from typing import Annotated

import typer

from envhub_sandbox.cli.shared.console import safe_text
from envhub_sandbox.options import OPTIONS

_PANEL = OPTIONS["output"].panel

Verbose = Annotated[
    bool,
    typer.Option(
        "--verbose", "-v", help="Tell of jails and downloads on stderr.", rich_help_panel=_PANEL
    ),
]


class _Safe(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return safe_text(super().format(record))


@contextlib.contextmanager
def logged(*, verbose: bool, worker_output: str | None) -> Iterator[None]:
    """Show logs on stderr while it lasts."""
    from envhub_sandbox.log import OUTPUT, ROOT

    shown = []
    if verbose:
        shown.append(_show(ROOT, logging.DEBUG, "%(asctime)s %(message)s"))
        shown[-1][1].addFilter(lambda record: record.name != OUTPUT.name)
        shown.append((OUTPUT, logging.NullHandler(), OUTPUT.level))
        OUTPUT.setLevel(logging.INFO)  # nobody follows what nobody reads
    if worker_output == "-":
        shown.append(_show(OUTPUT, logging.DEBUG, "%(message)s"))
    try:
        yield
    finally:
        for logger, handler, level in reversed(shown):
            logger.removeHandler(handler)
            logger.setLevel(level)


def _show(
    logger: logging.Logger, level: int, form: str
) -> tuple[logging.Logger, logging.Handler, int]:
    handler = logging.StreamHandler()
    handler.setLevel(level)
    handler.setFormatter(_Safe(form, "%H:%M:%S"))
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(level)
    return logger, handler, before
