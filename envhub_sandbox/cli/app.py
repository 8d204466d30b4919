"""The program ``envhub`` and its commands.

Typer's classes have what all commands share, since no callback sees the errors of its parser:
guarded output, help that is text, errors that name options.
"""

from __future__ import annotations

import inspect as python
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from envhub_sandbox.cli import cache, diff, image, lock, prefetch, push, replay, run
from envhub_sandbox.cli.check.check import check
from envhub_sandbox.cli.doctor.doctor import doctor
from envhub_sandbox.cli.init.init import init
from envhub_sandbox.cli.inspect import inspect
from envhub_sandbox.cli.shared.console import guarded, out
from envhub_sandbox.cli.shared.exits import EXIT_CODES, reported
from envhub_sandbox.cli.shared.versions import versions
from envhub_sandbox.settings.options import on_command_line, use_option_names

_COMMANDS: dict[str, Callable[..., None]] = {
    "run": run.run,
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
}
_GROUPS: dict[str, tuple[str, dict[str, Callable[..., None]]]] = {
    "cache": (
        "List and remove what was downloaded and made of it, and what killed clients have left.",
        {"list": cache.list_, "remove": cache.remove, "gc": cache.gc},
    ),
    "image": ("Container images for repositories.", {"build": image.build}),
}


class Program(TyperGroup):
    """``envhub``: CI systems obey nothing of what it prints, usage errors included."""

    def main(self, *args: Any, **options: Any) -> Any:
        """Run a command."""
        with guarded():
            return super().main(*args, **options)


class Command(TyperCommand):
    """One command, whose errors name the options that it has."""

    def __init__(self, *args: Any, **given: Any) -> None:
        super().__init__(*args, **given)
        paragraphs = python.cleandoc(self.help or "").split("\n\n")
        # rich keeps the ends of lines of all but the first
        self.help = "\n\n".join(" ".join(one.split()) for one in paragraphs)

    def invoke(self, ctx: Any) -> Any:
        """Call the function."""
        known = {name for one in self.params for name in one.opts}
        with use_option_names(on_command_line(known)):
            return super().invoke(ctx)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help, in which rich reads no ``[word]`` of an option as markup."""
        for one in self.params:
            text = getattr(one, "help", None)
            if text:
                vars(one)["help"] = text.replace("[", "\\[")
        super().format_help(ctx, formatter)


def _group(text: str, commands: Mapping[str, Callable[..., None]], **options: Any) -> typer.Typer:
    made = typer.Typer(help=text, no_args_is_help=True, rich_markup_mode="rich", **options)
    for name, command in commands.items():
        made.command(name, cls=Command, no_args_is_help=command is cache.remove)(command)
    return made


app = _group(
    "Run anybody's Gymnasium environment from the Hugging Face Hub, without letting its code "
    "into your process.",
    _COMMANDS,
    name="envhub",
    cls=Program,
    epilog=EXIT_CODES,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for name, group in _GROUPS.items():
    app.add_typer(_group(*group), name=name)


def _print_versions(wanted: bool) -> None:
    if wanted:
        with reported(debug=False):
            for name, text in versions().items():
                out(f"{name:<16} {text or 'not installed'}")
        raise typer.Exit


@app.callback()
def envhub(
    versions: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_print_versions,
            is_eager=True,
            help="Print versions: ours, the protocol's, Python's and of the packages that matter.",
        ),
    ] = False,
) -> None:
    """What stands before a command."""
