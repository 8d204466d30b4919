"""Options that several commands share, and how they become arguments of ``make_env``."""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import typer

from envhub_sandbox.cli.shared.exits import ForeignError, UsageError
from envhub_sandbox.cli.shared.logs import output_policy
from envhub_sandbox.errors import EnvHubError
from envhub_sandbox.option_names import OPTION_NAMES
from envhub_worker.protocol.confinement import NETWORKS, PROFILES
from envhub_worker.protocol.limits import MAX_NUM_ENVS
from envhub_worker.protocol.text import parse_size

_CODE, _LIMITS, _HUB = "How it is built", "What it may do", "Where it comes from"


def _one_of(*values: str) -> Callable[[], list[str]]:
    """What a shell completes."""
    return lambda: list(values)


Ref = Annotated[
    str,
    typer.Argument(
        metavar="REF",
        help="A hub reference, 'org/repo@revision:path/env.py', or a folder, './my-env'.",
        show_default=False,
    ),
]
NEnvs = Annotated[
    int,
    typer.Option(
        "--n-envs", "-n", min=1, max=MAX_NUM_ENVS, help="Sub-environments.", rich_help_panel=_CODE
    ),
]
UseAsync = Annotated[
    bool,
    typer.Option(
        "--async",
        help="Ask for use_async_envs=True: sub-environments may run in several processes.",
        rich_help_panel=_CODE,
    ),
]
EnvKwargs = Annotated[
    list[str] | None,
    typer.Option(
        "--env-kwargs",
        metavar="JSON|KEY=VALUE",
        help="Further arguments of the repository's make_env: a JSON object, or key=value "
        "(repeatable; values are JSON where they can be, else text).",
        rich_help_panel=_CODE,
    ),
]
Suite = Annotated[
    list[str] | None,
    typer.Option("--suite", help="Only this suite (repeatable).", rich_help_panel=_CODE),
]
Task = Annotated[
    list[str] | None,
    typer.Option("--task", help="Only this task id (repeatable).", rich_help_panel=_CODE),
]
Python = Annotated[
    str | None,
    typer.Option(
        metavar="PATH",
        help="The interpreter that runs the repository; this one by default.",
        rich_help_panel=_CODE,
    ),
]
Dependencies = Annotated[
    str,
    typer.Option(
        metavar="auto|declared|host|PATH|JSON",
        autocompletion=_one_of("auto", "declared", "host"),
        help="Where its packages come from: an environment of its own where this interpreter lacks "
        "something that it declares or imports; only what it declares; this interpreter; another, "
        "or a virtual environment; or one of its own, adjusted: "
        '\'{"extra": ["scipy"], "without": ["torch"], "python": "3.12"}\'.',
        rich_help_panel=_CODE,
    ),
]
Lock = Annotated[
    str | None,
    typer.Option(
        metavar="FILE",
        help="What 'envhub lock' wrote: its packages, and nothing that differs from it.",
        rich_help_panel=_CODE,
    ),
]
NumWorkers = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Processes over which sub-environments are spread.",
        rich_help_panel=_CODE,
    ),
]
Validate = Annotated[
    bool,
    typer.Option(
        "--validate",
        help="Hold every action and observation against its space, value by value.",
        rich_help_panel=_CODE,
    ),
]
SandboxName = Annotated[
    str,
    typer.Option(
        "--sandbox",
        metavar="process|docker[:IMAGE]|tcp://HOST:PORT",
        help="Where it runs.",
        autocompletion=_one_of("process", "docker", "tcp://"),
        rich_help_panel=_LIMITS,
    ),
]
SandboxOrNone = Annotated[
    str,
    typer.Option(
        "--sandbox",
        metavar="process|docker[:IMAGE]|tcp://HOST:PORT|none",
        help="Where it runs; 'none' is this process, unprotected.",
        autocompletion=_one_of("process", "docker", "tcp://", "none"),
        rich_help_panel=_LIMITS,
    ),
]
ServerKey = Annotated[
    str | None,
    typer.Option(
        metavar="KEY",
        help="With --sandbox tcp://...: that server's public key; else $ENVHUB_SERVER_KEY, or "
        "what known_hosts says.",
        rich_help_panel=_LIMITS,
    ),
]
Trust = Annotated[
    bool,
    typer.Option(
        "--trust-remote-code",
        help="Needed for --sandbox none, where nothing protects you.",
        rich_help_panel=_LIMITS,
    ),
]
Profile = Annotated[
    str | None,
    typer.Option(
        metavar="|".join(PROFILES),
        help="Which layers must hold; strict by default.",
        autocompletion=_one_of(*PROFILES),
        rich_help_panel=_LIMITS,
    ),
]
Network = Annotated[
    str | None,
    typer.Option(
        metavar="|".join(NETWORKS),
        help="None by default.",
        autocompletion=_one_of(*NETWORKS),
        rich_help_panel=_LIMITS,
    ),
]
Gpu = Annotated[
    str | None,
    typer.Option(
        "--gpu",
        metavar="all|N[,N]",
        help="Grant all GPUs, or those, as nvidia-smi counts them.",
        rich_help_panel=_LIMITS,
    ),
]
Readable = Annotated[
    list[str] | None,
    typer.Option(
        "--readable",
        metavar="PATH",
        help="A further absolute path that it may read (repeatable).",
        rich_help_panel=_LIMITS,
    ),
]
Variables = Annotated[
    list[str] | None,
    typer.Option(
        "--env",
        metavar="NAME",
        help="An environment variable that it may see (repeatable).",
        rich_help_panel=_LIMITS,
    ),
]
Memory = Annotated[
    str | None,
    typer.Option(metavar="SIZE", help="Memory, as in 512M or 4G.", rich_help_panel=_LIMITS),
]
Disk = Annotated[
    str | None,
    typer.Option(metavar="SIZE", help="Scratch space on disk.", rich_help_panel=_LIMITS),
]
Processes = Annotated[
    int | None,
    typer.Option(help="Processes and threads alive at once.", rich_help_panel=_LIMITS),
]
CpuTime = Annotated[
    int | None,
    typer.Option(metavar="SECONDS", help="CPU seconds of one process.", rich_help_panel=_LIMITS),
]
Timeout = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        help="How long loading, one reset, one step or one render may take; 300 by default.",
        rich_help_panel=_LIMITS,
    ),
]
Token = Annotated[
    str | None,
    typer.Option(
        help="For private repositories. Better: the variable HF_TOKEN, which no process list "
        "shows, or 'hf auth login'.",
        rich_help_panel=_HUB,
    ),
]
Endpoint = Annotated[
    str | None,
    typer.Option(
        metavar="URL", help="The Hub; $HF_ENDPOINT or huggingface.co.", rich_help_panel=_HUB
    ),
]
HubCacheDir = Annotated[
    str | None,
    typer.Option(metavar="PATH", help="huggingface_hub's cache_dir.", rich_help_panel=_HUB),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks.")]


@dataclass(frozen=True)
class MakeOptions:
    """What a command line says about ``make_env``.

    Attributes:
        ref: The reference.
        given: The values of the options that the command has, by keys of ``OPTION_NAMES``.
    """

    ref: str
    given: Mapping[str, Any]

    @classmethod
    def of(cls, context: Any) -> MakeOptions:
        """What a command was given."""
        values = {
            name: context.params[one.name] for one in context.command.params for name in one.opts
        }
        commands = {key: one.command for key, one in OPTION_NAMES.items()}
        given = {key: values[name] for key, name in commands.items() if name in values}
        return cls(context.params["ref"] or "", given)

    @property
    def in_process(self) -> bool:
        """Whether the repository's code runs in this process."""
        return bool(self.given["sandbox"] == "none")

    def arguments(self) -> dict[str, Any]:
        """The arguments of ``make_env``.

        Raises:
            UsageError: An option cannot be read.
        """
        if self.in_process and "trust_remote_code" not in self.given:
            raise UsageError("this command needs a sandbox; leave out --sandbox none")
        if self.in_process and not self.given["trust_remote_code"]:
            raise UsageError(
                f"--sandbox none runs the code of {self.ref} in this process, with everything that "
                "you may do. If you trust it, add --trust-remote-code. Otherwise leave out "
                "--sandbox none: the sandbox needs no trust."
            )
        made: dict[str, Any] = {"cfg": self.ref, "policy": {}, "limits": {}, "timeouts": {}}
        for key, value in self.given.items():
            one = OPTION_NAMES[key]
            value = _READERS.get(key, lambda given: given)(value)
            if not one.field:
                made[one.argument] = value
            elif value or type(value) in (int, float):  # else the library's default holds
                made[one.argument][key] = value
        if limits := made.pop("limits"):
            made["policy"]["limits"] = limits
        return made

    @contextlib.contextmanager
    def explained(self) -> Iterator[None]:
        """Without a sandbox whatever is raised is the repository's, and its prints go to stderr."""
        try:
            with prints_on_stderr() if self.in_process else contextlib.nullcontext():
                yield
        except Exception as error:
            if not self.in_process or isinstance(error, EnvHubError):
                raise
            text = f"{self.ref}: {type(error).__name__}: {error}"
            raise ForeignError(text) from error


def read_gpu(text: str | None) -> bool | list[int] | None:
    """``all`` or indices.

    Raises:
        UsageError: It is neither.
    """
    if text is None or text == "all":
        return None if text is None else True
    if not all(index.isdecimal() for index in text.split(",")):
        raise UsageError(f"--gpu is {text}; it takes all, or indices such as 0,1")
    return [int(index) for index in text.split(",")]


def is_typed(context: typer.Context, name: str) -> bool:
    """Whether a parameter stands on the command line, and not in a file or nowhere."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


@contextlib.contextmanager
def prints_on_stderr() -> Iterator[None]:
    """Keep stdout to the results: what Python prints meanwhile, and what libraries do."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def read_size(option: str, text: str | None) -> int | None:
    """Bytes from ``"512M"``, ``"1.5GiB"`` or ``"1048576"``; units are powers of 1024.

    Raises:
        UsageError: It is no size.
    """
    if text is None:
        return None
    try:
        return parse_size(text)
    except ValueError as error:
        raise UsageError(f"{option} is {text!r}; {error}") from None


def read_env_kwargs(texts: Sequence[str]) -> dict[str, Any]:
    """Keyword arguments from JSON objects and ``key=value`` pairs; later ones win.

    Raises:
        UsageError: One is neither.
    """
    values: dict[str, Any] = {}
    for text in texts:
        if text.lstrip().startswith("{"):
            values |= _json_object("--env-kwargs", text)
            continue
        key, equals, value = text.partition("=")
        if not equals or not key.isidentifier():
            raise UsageError(
                f"--env-kwargs is {text!r}; it takes a JSON object such as '{{\"size\": 8}}', or "
                "key=value"
            )
        values[key] = _json_or_text(value)
    return values


def read_dependencies(text: str) -> str | dict[str, Any]:
    """The argument of ``make_env``: text, or a JSON object.

    Raises:
        UsageError: It begins like an object and is none.
    """
    return _json_object("--dependencies", text) if text.lstrip().startswith("{") else text


def _json_object(option: str, text: str) -> dict[str, Any]:
    try:
        value: dict[str, Any] = json.loads(text)  # it starts with a brace: an object or an error
    except ValueError as error:
        raise UsageError(f"{option} is {text!r}, which is no JSON: {error}") from error
    return value


def _json_or_text(value: str) -> Any:
    try:
        return json.loads(value)
    except ValueError:
        return value


_READERS: dict[str, Callable[[Any], Any]] = {
    "sandbox": lambda name: None if name == "none" else name,
    "env_kwargs": lambda texts: read_env_kwargs(texts or ()),
    "dependencies": read_dependencies,
    "output": output_policy,
    "gpu": read_gpu,
}
"""How values are made of what was typed, where the two are not the same."""
