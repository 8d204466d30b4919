"""Options that several commands share, and how they become arguments of ``make_env``."""

from __future__ import annotations

import contextlib
import json
import os
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any

import typer

from envhub_sandbox.cli.shared.exits import ForeignError, UsageError
from envhub_sandbox.cli.shared.logs import output_policy
from envhub_sandbox.errors import EnvHubError
from envhub_worker.protocol.limits import MAX_NUM_ENVS

_CODE, _LIMITS, _HUB = "How it is built", "What it may do", "Where it comes from"
_UNITS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}

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
        metavar="auto|host|PATH|JSON",
        help="Where its packages come from: an environment of its own where this interpreter lacks "
        "some; this interpreter; another, or a virtual environment; or one of its own, adjusted: "
        '\'{"extra": ["scipy"], "python": "3.12", "exclude_newer": "2026-01-31"}\'.',
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
        metavar="process|docker[:IMAGE]|tcp://HOST:PORT|none",
        help="Where it runs; 'none' is this process, unprotected.",
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
        metavar="strict|no-userns|container",
        help="Which layers must hold; strict by default.",
        rich_help_panel=_LIMITS,
    ),
]
Network = Annotated[
    str | None,
    typer.Option(metavar="none|loopback|host", help="None by default.", rich_help_panel=_LIMITS),
]
Gpu = Annotated[
    bool, typer.Option("--gpu", help="Grant the GPU's device nodes.", rich_help_panel=_LIMITS)
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


@dataclass(frozen=True, kw_only=True)
class MakeOptions:
    """What the command line says about ``make_env``; field by field as its options.

    Those with a default are not options of every command.
    """

    ref: str
    n_envs: int
    use_async: bool
    env_kwargs: Sequence[str] | None
    python: str | None
    dependencies: str
    sandbox: str
    server_key: str | None
    profile: str | None
    memory: str | None
    disk: str | None
    processes: int | None
    cpu_time: int | None
    timeout: float | None
    token: str | None
    endpoint: str | None
    hub_cache_dir: str | None
    lock: str | None = None
    num_workers: int | None = None
    validate: bool = False
    trust: bool = False
    network: str | None = None
    gpu: bool = False
    readable: Sequence[str] | None = None
    variables: Sequence[str] | None = None
    worker_output: str | None = None

    @classmethod
    def of(cls, context: typer.Context, **others: Any) -> MakeOptions:
        """What a command was given: a parameter's field has its name.

        Args:
            context: The command's.
            **others: Fields that it says in another way.
        """
        names = {one.name for one in fields(cls)}
        given = {name: value for name, value in context.params.items() if name in names}
        return cls(**{**given, **others})

    @property
    def in_process(self) -> bool:
        """Whether the repository's code runs in this process."""
        return self.sandbox == "none"

    def arguments(self) -> dict[str, Any]:
        """The arguments of ``make_env``.

        Raises:
            UsageError: An option cannot be read.
        """
        if self.in_process and not self.trust:
            raise UsageError(
                f"--sandbox none runs the code of {self.ref} in this process, with everything that "
                "you may do. If you trust it, add --trust-remote-code. Otherwise leave out "
                "--sandbox none: the sandbox needs no trust."
            )
        return {
            "cfg": self.ref,
            "n_envs": self.n_envs,
            "use_async_envs": self.use_async,
            "hub_cache_dir": self.hub_cache_dir,
            "trust_remote_code": self.trust,
            "sandbox": None if self.in_process else self.sandbox,
            "server_key": self.server_key,
            "env_kwargs": read_env_kwargs(self.env_kwargs or ()),
            "policy": self._policy(),
            "timeouts": self._timeouts(),
            "token": self.token,
            "endpoint": self.endpoint,
            "python": self.python,
            "dependencies": read_dependencies(self.dependencies),
            "lock": self.lock,
            "num_workers": self.num_workers,
            "validate": self.validate,
        }

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

    def _policy(self) -> dict[str, Any]:
        limits = {
            "memory_bytes": read_size("--memory", self.memory),
            "disk_bytes": read_size("--disk", self.disk),
            "processes": self.processes,
            "cpu_s": self.cpu_time,
        }
        policy = {
            "profile": self.profile,
            "network": self.network,
            "gpu": self.gpu or None,
            "readable": tuple(self.readable or ()) or None,
            "environment": tuple(self.variables or ()) or None,
            "output": output_policy(self.worker_output),
            "limits": _given(limits) or None,
        }
        return _given(policy)

    def _timeouts(self) -> dict[str, Any]:
        names = ("startup_s", "reset_s", "step_s", "call_s")
        return {} if self.timeout is None else dict.fromkeys(names, self.timeout)


def is_typed(context: typer.Context, name: str) -> bool:
    """Whether a parameter stands on the command line, and not in a file or nowhere."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _given(options: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


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
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([kmgt]?)(?:i?b)?", text.strip().lower())
    if found is None:
        raise UsageError(f"{option} is {text!r}; it takes a size such as 512M or 4G")
    return int(float(found[1]) * _UNITS[found[2]])


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
