"""The command line's commands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import typer

from envhub_sandbox.cli import (
    cache,
    diff,
    gc,
    image,
    lock,
    prefetch,
    push,
    replay,
    version,
)
from envhub_sandbox.cli.check.check import check
from envhub_sandbox.cli.doctor.doctor import doctor
from envhub_sandbox.cli.init.init import init
from envhub_sandbox.cli.inspect.inspect import inspect
from envhub_sandbox.cli.run.run import run
from envhub_sandbox.cli.shared.exits import EXIT_CODES
from envhub_sandbox.cli.shared.program import Command, Program

app = typer.Typer(
    name="envhub",
    cls=Program,
    help="Run anybody's Gymnasium environment from the Hugging Face Hub, without letting its code "
    "into your process.",
    epilog=EXIT_CODES,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_versions(wanted: bool) -> None:
    if wanted:
        version.version()
        raise typer.Exit


@app.callback()
def envhub(
    versions: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_print_versions,
            is_eager=True,
            help="Print versions, as the command does.",
        ),
    ] = False,
) -> None:
    """What stands before a command."""


_COMMANDS: dict[str, Callable[..., None]] = {
    "run": run,
    "inspect": inspect,
    "check": check,
    "diff": diff.diff,
    "prefetch": prefetch.prefetch,
    "lock": lock.lock,
    "verify": lock.verify,
    "init": init,
    "push": push.push,
    "replay": replay.replay,
    "doctor": doctor,
    "gc": gc.gc,
    "version": version.version,
}
for name, command in _COMMANDS.items():
    app.command(name, cls=Command)(command)
app.add_typer(cache.app, name="cache")
app.add_typer(image.app, name="image")
