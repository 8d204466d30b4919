"""The table of all options of ``make_env``: type, default, check, help, and name for commands.

The parameters of ``envhub`` and the fields of LeRobot's configuration are made from this table.
``make_env`` has names and defaults in its signature too, for editors and readers;
a test compares the two.

An error names an option by its key (``option_name``). A command line calls ``use_option_names``, so
that errors write options as that command line does.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import json
import operator
import os
import shlex
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import field, fields, replace
from keyword import iskeyword
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from envhub_sandbox.errors import PolicyError
from envhub_worker.protocol.confinement import DISPLAYS, NETWORKS, PROFILES
from envhub_worker.protocol.limits import MAX_NUM_ENVS
from envhub_worker.protocol.records import dataclass

P = ParamSpec("P")
T = TypeVar("T")
MAX_ASSETS = 16
_CODE, _LIMITS, _HUB = "How it is built", "What it may do", "Where it comes from"


@dataclass(frozen=True)
class Option:
    """One option.

    Attributes:
        command: Its names for commands of ``envhub``; empty if no command has it.
        help: Its text in the help of a command.
        metavar: How the help writes a value; a shell completes the parts in lower case.
        kind: The type of its value on a command line; ``list`` is of texts, ``dict`` is JSON.
        least, most: The bounds of a number.
        check: Called with a value; returns its normal form, or raises.
        panel: Its heading in the help.
        sandboxed: Whether it has no meaning without a sandbox.
        travels: Whether a pickle of the environments contains it. Trust and secrets are not passed
            on, and limits are part of the policy.
        argument: The argument of ``make_env``.
        field: Its key, if that argument is a mapping.
        default: Its value if the caller does not set it.
    """

    command: str = ""
    help: str = ""
    metavar: str | None = None
    kind: type[Any] = str
    least: int | None = None
    most: int | None = None
    check: Callable[[Any], Any] | None = None
    panel: str = ""
    sandboxed: bool = False
    travels: bool = True
    argument: str = ""
    field: str = ""
    default: Any = None

    @property
    def parameter(self) -> str:
        """The name of a command's parameter for it."""
        name = self.command.split()[0].lstrip("-").replace("-", "_")
        return self.argument if iskeyword(name) else name

    def checked(self, value: Any) -> Any:
        """Check a value and return its normal form. Raises ``TypeError``, ``ValueError`` or
        ``PolicyError`` for an invalid value.
        """
        if self.check is not None:
            return self.check(value)
        if self.kind is bool:
            return self._flag(value)
        return value if self.least is None else self._whole(value)

    def _flag(self, value: Any) -> bool:
        import numpy as np  # late, so that a help does not wait for it

        if not isinstance(value, (bool, np.bool_)):
            raise TypeError(f"`{self.argument}` is {value!r}; it is True or False")
        return bool(value)

    def _whole(self, value: Any) -> int | None:
        """A whole number of Python or numpy as an ``int``; None if that is the default."""
        if value is None and self.default is None:
            return None
        try:
            count = operator.index(value)
        except TypeError:
            text = f"`{self.argument}` is {value!r}; it takes a whole number"
            raise TypeError(text) from None
        if self.least is not None and count < self.least:
            raise ValueError(f"`{self.argument}` is {count}, and must be at least {self.least}")
        if self.most is not None and count > self.most:
            raise ValueError(f"`{self.argument}` is {count}, and must be at most {self.most}")
        return count


def _path(argument: str) -> Callable[[Any], Any]:
    def checked(value: Any) -> Any:
        if value is not None and not isinstance(value, (str, os.PathLike)):
            raise TypeError(f"`{argument}` is {value!r}; it takes a path")
        return value

    return checked


def _assets(value: Any) -> tuple[str, ...]:
    if not isinstance(value, (list, tuple)) or not all(isinstance(ref, str) for ref in value):
        raise TypeError(f"`assets` is {value!r}; it takes a list such as ['org/data@COMMIT']")
    if len(value) > MAX_ASSETS:
        raise ValueError(f"`assets` has {len(value)} repositories; it takes {MAX_ASSETS} at most")
    return tuple(value)


def _keyword_arguments(value: Any) -> dict[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, Mapping) or not all(type(key) is str for key in value):
        raise TypeError(f"`env_kwargs` is {value!r}; it takes a mapping of names to values")
    for ours in ("n_envs", "use_async_envs"):
        if ours in value:
            raise TypeError(f"`env_kwargs` has {ours!r}, which is a separate argument")
    return dict(value)


def _option(default: Any, command: str = "", text: str = "", **attributes: Any) -> Any:
    return field(default=default, metadata={"option": Option(command, text, **attributes)})


@dataclass(frozen=True, kw_only=True, repr=False)
class Options:
    """The arguments of ``make_env`` beside its reference; its docstring explains each."""

    n_envs: int = _option(
        1, "--n-envs -n", "Sub-environments.", kind=int, least=1, most=MAX_NUM_ENVS
    )
    use_async_envs: bool = _option(
        False,
        "--async",
        "Ask for use_async_envs=True: sub-environments may run in several processes.",
        kind=bool,
    )
    env_kwargs: Mapping[str, Any] | None = _option(
        None,
        "--env-kwargs",
        "Further arguments of the repository's make_env: a JSON object, or key=value "
        "(repeatable; values are JSON where they can be, else text).",
        metavar="JSON|KEY=VALUE",
        kind=dict,
        check=_keyword_arguments,
    )
    python: str | Path | None = _option(
        None,
        "--python",
        "The interpreter that runs the repository; this one by default.",
        metavar="PATH",
        check=_path("python"),
        sandboxed=True,
    )
    dependencies: str | os.PathLike[str] | Mapping[str, Any] = _option(
        "auto",
        "--dependencies",
        "Where its packages come from. auto: a separate environment, if this interpreter lacks "
        "something that it declares or imports; declared: the same, without mere imports; host: "
        "this interpreter; PATH: another one or a virtual environment; JSON: its own, adjusted: "
        '\'{"extra": ["scipy"], "without": ["torch"], "python": "3.12"}\'.',
        metavar="auto|declared|host|PATH|JSON",
        sandboxed=True,
    )
    lock: str | os.PathLike[str] | None = _option(
        None,
        "--lock",
        "A file of 'envhub lock': use its packages; any difference is an error.",
        metavar="FILE",
        check=_path("lock"),
        sandboxed=True,
    )
    assets: Sequence[str] = _option(
        (),
        "--assets",
        "Another repository of the Hub that it may read, as in datasets/org/data@COMMIT "
        "(repeatable).",
        metavar="REF",
        kind=list,
        check=_assets,
        panel=_HUB,
        sandboxed=True,
    )
    num_workers: int | None = _option(
        None,
        "--num-workers",
        "Processes for the sub-environments.",
        kind=int,
        least=1,
        sandboxed=True,
    )
    min_ready: int | None = _option(None, kind=int, least=1, sandboxed=True)
    copy: bool = _option(True, kind=bool)
    sandbox: Any = _option(
        "process",
        "--sandbox",
        "Where it runs; several places are separated by commas.",
        metavar="process|docker[:IMAGE]|ray|tcp://HOST:PORT[ KEY]",
        panel=_LIMITS,
    )
    trust_remote_code: bool = _option(
        False,
        "--trust-remote-code",
        "Needed for --sandbox none, where nothing protects you.",
        kind=bool,
        panel=_LIMITS,
        travels=False,
    )
    policy: Any = _option(None, kind=dict, sandboxed=True)
    timeouts: Any = _option(None, kind=dict, sandboxed=True)
    limits: Any = _option(None, kind=dict, sandboxed=True, travels=False)
    token: str | bool | None = _option(
        None,
        "--token",
        "For private repositories. Better: the variable HF_TOKEN, because process lists show "
        "options, or 'hf auth login'.",
        panel=_HUB,
        travels=False,
    )
    endpoint: str | None = _option(
        None, "--endpoint", "The Hub; $HF_ENDPOINT or huggingface.co.", metavar="URL", panel=_HUB
    )
    hub_cache_dir: str | Path | None = _option(
        None,
        "--hub-cache-dir",
        "huggingface_hub's cache_dir.",
        metavar="PATH",
        check=_path("hub_cache_dir"),
        panel=_HUB,
    )

    allow_secrets: bool = _option(
        False,
        "--allow-secrets",
        "Let it see a folder of this machine that holds keys or passwords, or is a home directory.",
        kind=bool,
        panel=_HUB,
    )

    @property
    def source(self) -> dict[str, Any]:
        """The arguments of ``snapshot_named`` for the reference."""
        return {**self.hub, "allow_secrets": self.allow_secrets}

    @property
    def hub(self) -> dict[str, Any]:
        """The arguments that choose the Hub, its login and its cache."""
        return {key: getattr(self, key) for key in ("token", "endpoint", "hub_cache_dir")}

    def checked(self) -> Options:
        """Check all options; returns their normal forms."""
        values = vars(self).items()
        return Options(**{name: OPTIONS[name].checked(value) for name, value in values})

    def refuse_sandboxed(self) -> None:
        """Raise ``PolicyError`` for options that would do nothing without a sandbox."""
        values = {name: value for name, value in vars(self).items() if OPTIONS[name].sandboxed}
        idle = [name for name, value in values.items() if value and value != OPTIONS[name].default]
        if idle:
            raise PolicyError(
                f"{', '.join(idle)}: for environments in a sandbox; with sandbox=None there is none"
            )

    def for_a_recipe(self, **changes: Any) -> dict[str, Any]:
        """The options that make the same environments in another process."""
        lock = None if self.lock is None else os.path.abspath(self.lock)
        kept = {name: value for name, value in vars(self).items() if OPTIONS[name].travels}
        return {**kept, "lock": lock, **changes}


_TIMEOUT = Option(
    "--timeout",
    "Longest time for loading, one reset, one step or one render; 300 by default.",
    "SECONDS",
    float,
)
_KEYS: dict[str, dict[str, Option]] = {
    "policy": {
        "profile": Option(
            "--profile",
            "Which layers must confine the jail; strict by default.",
            "|".join(PROFILES),
        ),
        "network": Option(
            "--network", "Which network the jail has; none by default.", "|".join(NETWORKS)
        ),
        "display": Option(
            "--display",
            "A separate X display in the jail, by Xvfb; none by default.",
            "|".join(DISPLAYS),
        ),
        "gpu": Option("--gpu", "Grant all GPUs, or these, numbered as by nvidia-smi.", "all|N[,N]"),
        "readable": Option(
            "--readable", "An absolute path that the jail may read (repeatable).", "PATH", list
        ),
        "environment": Option(
            "--environment",
            "An environment variable that the jail may see (repeatable).",
            "NAME",
            list,
        ),
        "output": Option(
            "--worker-output",
            "Write the worker's output to this file, that of further jails to further files; - is "
            "stderr.",
            "FILE|-",
            panel="What it logs",
        ),
    },
    "limits": {
        "memory_bytes": Option("--memory", "Memory of a jail, as in 512M or 4G.", "SIZE"),
        "disk_bytes": Option("--disk", "Scratch space of a jail, as in 512M or 4G.", "SIZE"),
        "processes": Option(
            "--processes", "Processes and threads of a jail at the same time.", kind=int
        ),
        "cpu_time_s": Option("--cpu-time", "CPU seconds that one process may use.", "SECONDS", int),
    },
    "timeouts": dict.fromkeys(("startup_s", "reset_s", "step_s", "call_s"), _TIMEOUT),
}
"""For each argument that is a mapping, the keys that commands have."""
_IN_PYTHON = {
    "policy": "restart restart_budget restart_backoff_s record_denials crash_history crash_folder "
    "prewarm lane",
    "limits": "open_files disk_files file_bytes output_bytes message_bytes elements",
    "timeouts": "close_s idle_s server_idle_s",
}
"""For each argument that is a mapping, the keys that only Python has."""


def _table() -> dict[str, Option]:
    options = {}
    for item in fields(Options):
        option = item.metadata["option"]
        panel = option.panel or _CODE
        options[item.name] = replace(option, argument=item.name, default=item.default, panel=panel)
    for argument, keys in _KEYS.items():
        for key, option in {
            **keys,
            **dict.fromkeys(_IN_PYTHON[argument].split(), Option()),
        }.items():
            panel = option.panel or _LIMITS
            options[key] = replace(option, argument=argument, field=key, panel=panel)
    return options


OPTIONS = _table()
"""Every argument of ``make_env``, and every key of its mappings, by name."""

Spelling = Callable[[Option, Any], str]
"""Writes an option with a value, as in Python or on a command line."""
_NO_VALUE = object()


def in_python(option: Option, value: Any) -> str:
    """Write ``dependencies='host'``, ``policy={'profile': 'no-userns'}``."""
    if value is _NO_VALUE:
        return f"{option.argument}: {option.field}" if option.field else option.argument
    return f"{option.argument}={ {option.field: value} if option.field else value!r}"


def on_command_line(available: Collection[str]) -> Spelling:
    """Write ``--dependencies host``, ``--profile no-userns``, and an option for each of a list;
    options that the command lacks are written as in Python.
    """

    def spelling(option: Option, value: Any) -> str:
        command = option.command.partition(" ")[0]
        if not command or command not in available or value is False:
            return f"{in_python(option, value)} in Python"
        if value is _NO_VALUE or value is True:
            return command
        every = value if option.kind is list and isinstance(value, list) else [value]
        return " ".join(f"{command} {shlex.quote(_text(member))}" for member in every)

    return spelling


def on_lerobots_command_line(prefix: str = "--env.") -> Spelling:
    """Write ``--env.dependencies=host``, ``--env.policy='{"profile": "no-userns"}'``."""

    def spelling(option: Option, value: Any) -> str:
        if value is _NO_VALUE:
            return f"{prefix}{in_python(option, value)}"
        shown = {option.field: value} if option.field else value
        return f"{prefix}{option.argument}={shlex.quote(_text(shown))}"

    return spelling


def json_or_text(text: str) -> Any:
    """The value of a text that is JSON, else the text itself."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


_spelling: Spelling = in_python


def option_name(key: str, value: Any = _NO_VALUE) -> str:
    """An option with a value, written as the user writes it: in Python or on a command line."""
    return _spelling(OPTIONS[key], value)


def nearest(name: object, names: Iterable[str], cutoff: float = 0.6) -> str:
    """A question in brackets that suggests the most similar known name; empty if there is none."""
    import difflib

    close = difflib.get_close_matches(str(name), list(names), 1, cutoff)
    return f" (did you mean {close[0]!r}?)" if close else ""


def refuse_unknown_arguments(make: Callable[P, T]) -> Callable[P, T]:
    """Decorate ``make_env``, so that a ``TypeError`` says where an unknown argument belongs."""
    arguments = inspect.signature(make).parameters

    @functools.wraps(make)
    def checked(*args: P.args, **kwargs: P.kwargs) -> T:
        for name in kwargs.keys() - arguments:
            hint = nearest(name, arguments)
            raise TypeError(f"make_env has no argument {name!r}{hint}; {_place_of(name)}")
        return make(*args, **kwargs)

    return checked


def _place_of(name: str) -> str:
    if name == "server_key":
        return "a server's key follows its address: sandbox='tcp://HOST:PORT KEY'"
    if name in OPTIONS:
        argument = OPTIONS[name].argument
        return f"it is a key of {argument}: {argument}={{{name!r}: ...}}"
    return "what the repository's own make_env takes is in env_kwargs={...}"


@contextlib.contextmanager
def use_option_names(spelling: Spelling) -> Iterator[None]:
    """Within this context, write options by ``spelling``, in all threads of this process."""
    global _spelling
    before, _spelling = _spelling, spelling
    try:
        yield
    finally:
        _spelling = before
