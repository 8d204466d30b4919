"""The program and its commands: guarded output, help that is text, errors that name options.

Typer's classes are the place for it, since no callback sees the errors of the option parser.
"""

from __future__ import annotations

import inspect
from typing import Any

from typer.core import TyperCommand, TyperGroup

from envhub_sandbox.cli.shared.console import guarded
from envhub_sandbox.option_names import on_command_line, use_option_names


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
        paragraphs = inspect.cleandoc(self.help or "").split("\n\n")
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
