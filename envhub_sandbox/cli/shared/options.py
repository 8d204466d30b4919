"""The options of ``make_env`` as parameters of commands: declares, reads and passes them on."""

from __future__ import annotations

import contextlib
import functools
import inspect
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

import typer

from envhub_sandbox.cli.shared.console import prints_on_stderr, safe_line
from envhub_sandbox.cli.shared.exits import ForeignError, UsageError, reported
from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.settings.options import OPTIONS, json_or_text
from envhub_worker.protocol.text import first_of

if TYPE_CHECKING:
    from envhub_sandbox.hub.snapshot import Snapshot

ALL = tuple(key for key, option in OPTIONS.items() if option.command)
"""Every option that a command can have, by keys of ``OPTIONS``."""
_HUB = ("token", "endpoint", "hub_cache_dir")
SOURCE = (*_HUB, "allow_secrets")
_PANEL = OPTIONS["n_envs"].panel
_NAMED = 20

Ref = Annotated[
    str,
    typer.Argument(
        metavar="REF",
        help="A hub reference, 'org/repo@revision:path/env.py', 'github:org/repo@commit', "
        "'pypi:package#id', or a folder, './my-env'.",
        show_default=False,
    ),
]
Suite = Annotated[
    list[str] | None,
    typer.Option("--suite", help="Only this suite (repeatable).", rich_help_panel=_PANEL),
]
Task = Annotated[
    list[str] | None,
    typer.Option("--task", help="Only this task id (repeatable).", rich_help_panel=_PANEL),
]
SEVERITIES = ["error", "warning", "note"]
FailOn = Annotated[
    str | None,
    typer.Option(
        "--fail-on",
        metavar="|".join(SEVERITIES),
        autocompletion=SEVERITIES.copy,
        help="Exit with 1 for findings of this severity or a worse one.",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks.")]

_Command = Callable[..., None]


def with_options(*keys: str, **defaults: Any) -> Callable[[_Command], _Command]:
    """Decorate a command: report its errors, and add options.

    The options are ``--debug``, and those of ``make_env`` in place of a parameter ``make``, which
    gets ``MakeOptions``. ``defaults``: the defaults that differ from ``make_env``'s.
    """
    options = {OPTIONS[key].parameter: _parameter(key, keys, defaults) for key in keys}

    def decorate(function: _Command) -> _Command:
        own = inspect.signature(function, eval_str=True).parameters
        shown: dict[str, inspect.Parameter] = {}
        for name, parameter in own.items():
            shown |= options if name == "make" else {name: parameter}
        shown.setdefault("debug", _keyword("debug", False, Debug))

        @functools.wraps(function)
        def command(**arguments: Any) -> None:
            debug = (
                arguments.get("debug", False) if "debug" in own else arguments.pop("debug", False)
            )
            with reported(debug=debug):
                values = {name: arguments.pop(name) for name in options}
                if "make" in own:
                    typed = {key: values[OPTIONS[key].parameter] for key in keys}
                    arguments["make"] = MakeOptions(arguments.get("ref") or "", typed)
                function(**arguments)

        # typer reads these two
        vars(command)["__signature__"] = inspect.Signature(
            [_keyword(name, each.default, each.annotation) for name, each in shown.items()]
        )
        command.__annotations__ = {name: each.annotation for name, each in shown.items()}
        return command

    return decorate


def _keyword(name: str, default: Any, annotation: Any) -> inspect.Parameter:
    """Make a keyword-only parameter."""
    kind = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, kind, default=default, annotation=annotation)


def _parameter(key: str, others: Sequence[str], defaults: Mapping[str, Any]) -> inspect.Parameter:
    declared = OPTIONS[key]
    if key == "sandbox" and "trust_remote_code" in others:
        text = "Where it runs; 'none' is this process, unprotected."
        declared = replace(declared, metavar=f"{declared.metavar}|none", help=text)
    # for a shell's completion: the parts of the metavar in lower case
    parts = (declared.metavar or "").split("|")
    matches = [re.match(r"[a-z][a-z:/-]*", part) for part in parts]
    words = [match[0] for match in matches if match is not None]
    option = typer.Option(
        *declared.command.split(),
        help=declared.help,
        metavar=declared.metavar,
        min=declared.least,
        max=declared.most,
        autocompletion=words.copy if words else None,
        rich_help_panel=declared.panel,
    )
    default = defaults.get(key, declared.default)
    kind: Any = list[str] if declared.kind in (list, dict) else declared.kind
    annotation: Any = Annotated[kind if default is not None else kind | None, option]
    return _keyword(declared.parameter, default, annotation)


@dataclass(frozen=True)
class MakeOptions:
    """The options of ``make_env`` on a command line.
    ``typed``: the values of the options that the command has, as typed, by keys of ``OPTIONS``.
    """

    ref: str
    typed: Mapping[str, Any]

    def __getitem__(self, key: str) -> Any:
        """Convert an option for ``make_env``. Raises ``UsageError``: its text is invalid."""
        if key == "sandbox" and self.in_process:
            self._check_trust()
        reader, value = _READERS.get(key), self.typed[key]
        return value if reader is None else reader(value)

    def snapshot(self, ref: str, *, public: bool = False) -> Snapshot:
        """Fetch the snapshot of a reference; ``public`` as for ``fetch``."""
        from envhub_sandbox.hub.snapshot import snapshot_named

        return snapshot_named(ref, **self.source, public=public)

    def snapshot_with_assets(self, ref: str, locked: Sequence[str] = ()) -> Snapshot:
        """Fetch a snapshot with its assets, from the command line or from a lock."""
        from envhub_sandbox.hub.snapshot import with_assets

        return with_assets(self.snapshot(ref), self.typed.get("assets") or (), self.hub, locked)

    @property
    def source(self) -> dict[str, Any]:
        """The arguments of ``snapshot_named`` for the reference."""
        return {key: self.typed[key] for key in SOURCE}

    @property
    def hub(self) -> dict[str, Any]:
        """The arguments that choose the Hub, its login and its cache."""
        return {key: self.typed[key] for key in _HUB}

    @property
    def in_process(self) -> bool:
        """Whether the repository's code runs in this process."""
        return bool(self.typed["sandbox"] == "none")

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of ``make_env``. Raises ``UsageError``: an option is invalid."""
        arguments: dict[str, Any] = {"cfg": self.ref, "policy": {}, "limits": {}, "timeouts": {}}
        for key in self.typed:
            option, value = OPTIONS[key], self[key]
            if not option.field:
                arguments[option.argument] = value
            elif value or type(value) in (int, float):  # else the library's default holds
                arguments[option.argument][key] = value
        if limits := arguments.pop("limits"):
            arguments["policy"]["limits"] = limits
        return arguments

    def _check_trust(self) -> None:
        if "trust_remote_code" not in self.typed:
            raise UsageError("this command needs a sandbox; leave out --sandbox none")
        if not self.typed["trust_remote_code"]:
            raise UsageError(
                f"--sandbox none runs the code of {self.ref} in this process, with all your "
                "permissions. If you trust it, add --trust-remote-code. Otherwise leave out "
                "--sandbox none: the sandbox needs no trust."
            )

    @contextlib.contextmanager
    def explained(self) -> Iterator[None]:
        """Without a sandbox, raise ``ForeignError`` for the code's errors, and print to stderr."""
        try:
            with prints_on_stderr() if self.in_process else contextlib.nullcontext():
                yield
        except Exception as error:
            if not self.in_process or isinstance(error, EnvHubError):
                raise
            text = f"{self.ref}: {type(error).__name__}: {error}"
            raise ForeignError(text) from error


def select_envs(
    envs: Mapping[str, Mapping[Any, Any]], suites: Sequence[str] | None, tasks: Sequence[str] | None
) -> list[tuple[str, Any, Any]]:
    """Return ``(suite, task, env)`` for each chosen environment; for all if none is chosen.
    Raises ``UsageError``: no environment matches; the text lists all suites and tasks.
    """
    every = [(suite, task, env) for suite, group in envs.items() for task, env in group.items()]
    chosen = [
        item
        for item in every
        if (not suites or str(item[0]) in suites) and (not tasks or str(item[1]) in tasks)
    ]
    if not chosen:
        names = [safe_line(f"{suite}/{task}", 80) for suite, task, _ in every]
        shown = ", ".join(first_of(names, _NAMED))
        raise UsageError(f"no such suite or task; there are (suite/task): {shown}")
    return chosen


def read_gpu(text: str | None) -> bool | list[int] | None:
    """Read ``all`` or indices. Raises ``UsageError``: the text is neither."""
    if text is None or text == "all":
        return None if text is None else True
    if not all(index.isdecimal() for index in text.split(",")):
        raise UsageError(f"--gpu is {text}; it takes all, or indices such as 0,1")
    return [int(index) for index in text.split(",")]


def is_typed(context: typer.Context, name: str) -> bool:
    """Whether a parameter is on the command line, and not from a file or a default."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def read_env_kwargs(texts: Sequence[str] | None) -> dict[str, Any]:
    """Read keyword arguments from JSON objects and ``key=value`` pairs; later ones win.
    Raises ``UsageError``: a text is neither.
    """
    values: dict[str, Any] = {}
    for text in texts or ():
        if text.lstrip().startswith("{"):
            values |= _json_object("--env-kwargs", text)
            continue
        key, equals, value = text.partition("=")
        if not equals or not key.isidentifier():
            raise UsageError(
                f"--env-kwargs is {text!r}; it takes a JSON object such as '{{\"size\": 8}}', or "
                "key=value"
            )
        values[key] = json_or_text(value)
    return values


def _json_object(option: str, text: str) -> dict[str, Any]:
    try:
        value: dict[str, Any] = json.loads(text)  # it starts with a brace: an object or an error
    except ValueError as error:
        raise UsageError(f"{option} is {text!r}, which is not valid JSON: {error}") from error
    return value


def _read_dependencies(text: str) -> Any:
    return _json_object("--dependencies", text) if text.lstrip().startswith("{") else text


def _none_for(word: str, name: str) -> str | None:
    return None if name == word else name


_READERS: dict[str, Callable[[Any], Any]] = {
    "sandbox": functools.partial(_none_for, "none"),
    "env_kwargs": read_env_kwargs,
    "dependencies": _read_dependencies,
    "output": functools.partial(_none_for, "-"),  # the log of run
    "gpu": read_gpu,
}
"""Functions that convert typed texts to values, for options that need it."""
