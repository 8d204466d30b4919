"""The command line's commands."""

from __future__ import annotations

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

app = typer.Typer(
    name="envhub",
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


app.command("run", epilog=EXIT_CODES)(run)
app.command("inspect", epilog=EXIT_CODES)(inspect)
app.command("check", epilog=EXIT_CODES)(check)
app.command("diff", epilog=EXIT_CODES)(diff.diff)
app.command("prefetch", epilog=EXIT_CODES)(prefetch.prefetch)
app.command("lock", epilog=EXIT_CODES)(lock.lock)
app.command("verify", epilog=EXIT_CODES)(lock.verify)
app.command("init")(init)
app.command("push", epilog=EXIT_CODES)(push.push)
app.command("replay", epilog=EXIT_CODES)(replay.replay)
app.command("doctor")(doctor)
app.add_typer(cache.app, name="cache")
app.add_typer(image.app, name="image")
app.command("gc")(gc.gc)
app.command("version")(version.version)
