"""The program ``envhub`` and its commands.

Subclasses of typer's classes do what all commands share, since no callback sees errors of typer's
parser: they guard the output, print help as plain text, and name options in errors.
"""

from __future__ import annotations

import contextlib
import inspect as python
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from envhub_sandbox.cli.shared.console import expects_json, guarded, out, print_json_error, say
from envhub_sandbox.cli.shared.exits import EXIT_CODES, Exit, reported
from envhub_sandbox.errors import SandboxUnavailableError
from envhub_sandbox.settings.options import OPTIONS, on_command_line, use_option_names
from envhub_sandbox.system import extras

Where = Mapping[str, str]
"""The commands of a group, each with its function as ``module:function`` of ``envhub_sandbox``."""

# with the first line of each command's help, so that a list of commands imports none of them
_COMMANDS: dict[str, tuple[str, str | Where]] = {
    "run": (
        "Play episodes of an environment and print returns, lengths, speed and provenance.",
        "cli.run:run",
    ),
    "inspect": (
        "Print suites, tasks, spaces, metadata and provenance, without stepping anything.",
        "cli.inspect:inspect",
    ),
    "check": (
        "Run a repository in a sandbox and report what is wrong with it.",
        "extras.judge.command.check:check",
    ),
    "diff": (
        "Compare two commits: files, packages, imports and findings; with --run, tasks and spaces.",
        "extras.judge.command.diff:diff",
    ),
    "lock": (
        "Record commit, file hashes, packages, Python and spaces in a file for "
        "make_env(lock=FILE); with --check, compare a repository with one.",
        "extras.packages.commands.lock:lock",
    ),
    "init": (
        "Write a new environment's repository: env.py, requirements, card, licence, test, CI "
        "workflow.",
        "extras.starter.command:init",
    ),
    "replay": (
        "Repeat the requests of a crash bundle, and report whether it dies in the same way.",
        "extras.crash.command:replay",
    ),
    "doctor": (
        "Test what this host can enforce, and print what is missing and how to get it.",
        "cli.doctor:doctor",
    ),
    "cache": (
        "List and remove snapshots, installed packages, and what killed clients left behind.",
        {"list": "cli.cache:list_", "remove": "cli.cache:remove", "gc": "cli.cache:gc"},
    ),
    "image": ("Build container images for repositories.", {"build": "extras.docker.command:build"}),
}

_FIRST = {"--n-envs", "--network", "--sandbox", "--task"}
"""The options of ``make_env`` that ``--help`` shows; ``--help-all`` shows all."""
_REPLACED = {
    "push": "envhub check . && hf upload OWNER/NAME .",
    "verify": "envhub lock --check FILE",
    "prefetch": "envhub inspect --download REF",
    "--server-key": "tcp://HOST:PORT KEY",
}
"""The replacements of former commands and options."""


class Program(TyperGroup):
    """``envhub``: CI systems find no commands in its output, usage errors included.

    A command is imported when it is called; until then only its name and help line are known.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        if not self.commands:
            self.commands = {
                name: Command(name, help=text) for name, (text, _) in _COMMANDS.items()
            }

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Import the called command and return it."""
        options = {word.partition("=")[0] for word in args if word.startswith("--")}
        for word in _REPLACED.keys() & {args[0], *options}:
            ctx.fail(f"There is no {word!r} any more: use '{_REPLACED[word]}'.")
        if args[0] in _COMMANDS:
            try:
                self.commands[args[0]] = whole_command(args[0])
            except SandboxUnavailableError as missing:
                ctx.fail(str(missing))
        return super().resolve_command(ctx, args)

    def main(self, args: Any = None, *more: Any, **options: Any) -> Any:
        """Run a command."""
        words = sys.argv[1:] if args is None else list(args)
        with guarded(), expects_json(words):
            return super().main(args, *more, **options)

    def make_context(self, *args: Any, **options: Any) -> Any:
        """Parse the options before a command."""
        with _wrong_usage():
            return super().make_context(*args, **options)

    def invoke(self, ctx: Any) -> Any:
        """Parse a command's options, and call it."""
        with _wrong_usage(ctx):
            return super().invoke(ctx)


@contextlib.contextmanager
def _wrong_usage(ctx: Any = None) -> Iterator[None]:
    """Report the parser's errors like every other error: as one message, without a box."""
    try:
        yield
    except Exception as error:
        # the parser's errors have this method; the module of their class varies with typer
        text = error.format_message() if hasattr(error, "format_message") else ""
        if not text:  # another error; or a command without arguments, which prints its help
            raise
        end = "" if text[-1] in ".?!)" else "."
        # an option without its value has no context: the command is known by its name
        command = " ".join(filter(None, ["envhub", getattr(ctx, "invoked_subcommand", None)]))
        path = getattr(getattr(error, "ctx", None), "command_path", command)
        message = f"{text}{end} Try '{path} --help'."
        say(f"Error: {message}", style="red")
        print_json_error("UsageError", message, Exit.USAGE)
        raise typer.Exit(Exit.USAGE) from None


class Command(TyperCommand):
    """A command whose errors name its own options."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        paragraphs = python.cleandoc(self.help or "").split("\n\n")
        # rich keeps line breaks in all paragraphs but the first
        self.help = "\n\n".join(" ".join(text.split()) for text in paragraphs)

    def invoke(self, ctx: Any) -> Any:
        """Call the function."""
        options = {name for parameter in self.params for name in parameter.opts}
        with use_option_names(on_command_line(options)):
            return super().invoke(ctx)

    def parse_args(self, ctx: Any, args: list[str]) -> Any:
        """Parse options; ``--help-all`` is ``--help`` with all options."""
        self._whole_help = "--help-all" in args
        return super().parse_args(ctx, ["--help" if a == "--help-all" else a for a in args])

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help, escaped so that rich reads no ``[word]`` of an option as markup."""
        for parameter in self.params:
            text = getattr(parameter, "help", None)
            if text:
                vars(parameter)["help"] = text.replace("[", "\\[")
        later = [] if self._whole_help else list(filter(_comes_later, self.params))
        for parameter in later:
            vars(parameter)["hidden"] = True
        if later:
            self.epilog = f"{len(later)} more options: {ctx.command_path} --help-all"
        super().format_help(ctx, formatter)


def _comes_later(parameter: Any) -> bool:
    """Whether a parameter is an option of ``make_env`` that few users need."""
    panels = {option.panel for option in OPTIONS.values()}
    panel = getattr(parameter, "rich_help_panel", None)
    return panel in panels and not _FIRST.intersection(parameter.opts)


def functions(name: str) -> dict[str, Callable[..., None]]:
    """Import the function of a command, or those of a group, by name."""
    address = _COMMANDS[name][1]
    functions = {}
    for command, path in ({name: address} if isinstance(address, str) else address).items():
        module, _, function = path.partition(":")
        functions[command] = extras.required(f"envhub_sandbox.{module}", function, f"envhub {name}")
    return functions


def whole_command(name: str) -> Any:
    """Make a command, or a group, with all its options."""
    text, address = _COMMANDS[name]
    typer_group = _typer(text)
    for command, function in functions(name).items():
        typer_group.command(command, cls=Command, no_args_is_help=command == "remove")(function)
    group = typer.main.get_group(typer_group)
    group.name = name
    return group.commands[name] if isinstance(address, str) else group


def _typer(text: str, **options: Any) -> typer.Typer:
    return typer.Typer(help=text, no_args_is_help=True, rich_markup_mode="rich", **options)


app = _typer(
    "Run anybody's Gymnasium environment from the Hugging Face Hub, without letting its code "
    "into your process.",
    name="envhub",
    cls=Program,
    epilog=EXIT_CODES,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_versions(wanted: bool) -> None:
    if wanted:
        from envhub_sandbox.cli.shared.host import versions

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
            help="Print the versions of envhub, the protocol, Python and the packages that matter.",
        ),
    ] = False,
) -> None:
    """The options before a command."""
