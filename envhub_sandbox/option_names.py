"""How each option of ``make_env`` is written: in Python, for ``envhub``, and for LeRobot.

An error names an option by its key, and the place that the user is at decides how it is written:
``use_option_names`` is called by whoever reads a command line. Nothing else knows two spellings.
"""

from __future__ import annotations

import contextlib
import json
import shlex
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class OptionName:
    """One option.

    Attributes:
        argument: Of ``make_env``.
        field: Its key, where the argument is a mapping.
        command: The option of ``envhub`` commands that have one.
    """

    argument: str
    field: str = ""
    command: str = ""


_TABLE = {
    "": "n_envs=--n-envs use_async_envs=--async hub_cache_dir=--hub-cache-dir "
    "trust_remote_code=--trust-remote-code sandbox=--sandbox env_kwargs=--env-kwargs "
    "token=--token endpoint=--endpoint python=--python dependencies=--dependencies lock=--lock "
    "num_workers=--num-workers validate=--validate server_key=--server-key prewarm lane copy",
    "policy": "profile=--profile network=--network readable=--readable gpu=--gpu environment=--env "
    "output=--worker-output restart restart_budget restart_backoff_s record_denials crash_history "
    "crash_folder",
    "limits": "memory_bytes=--memory disk_bytes=--disk processes=--processes cpu_s=--cpu-time "
    "open_files disk_files file_bytes output_bytes message_bytes elements",
    "timeouts": "startup_s=--timeout reset_s=--timeout step_s=--timeout call_s=--timeout close_s "
    "idle_s server_idle_s",
}
"""By the argument that is a mapping: its keys, each with the option of ``envhub`` for it."""


def _read() -> Iterator[tuple[str, OptionName]]:
    for argument, keys in _TABLE.items():
        for key, _, command in (word.partition("=") for word in keys.split()):
            yield key, OptionName(argument or key, key if argument else "", command)


OPTION_NAMES = dict(_read())
"""By key: the argument, or the field of the mapping that the argument is."""

Spelling = Callable[[OptionName, Any], str]
_NO_VALUE = object()


def in_python(option: OptionName, value: Any) -> str:
    """``dependencies='host'``, ``policy={'profile': 'no-userns'}``."""
    if value is _NO_VALUE:
        return f"{option.argument}: {option.field}" if option.field else option.argument
    return f"{option.argument}={ {option.field: value} if option.field else value!r}"


def on_command_line(known: Collection[str]) -> Spelling:
    """``--dependencies host``, ``--profile no-userns``; in Python what a command does not have.

    Args:
        known: The options of the command.
    """

    def spelling(option: OptionName, value: Any) -> str:
        if not option.command or option.command not in known or value is False:
            return f"{in_python(option, value)} in Python"
        if value is _NO_VALUE or value is True:
            return option.command
        return f"{option.command} {shlex.quote(_text(value))}"

    return spelling


def on_lerobots_command_line(prefix: str = "--env.") -> Spelling:
    """``--env.dependencies=host``, ``--env.policy='{"profile": "no-userns"}'``."""

    def spelling(option: OptionName, value: Any) -> str:
        if value is _NO_VALUE:
            return f"{prefix}{in_python(option, value)}"
        given = {option.field: value} if option.field else value
        return f"{prefix}{option.argument}={shlex.quote(_text(given))}"

    return spelling


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


_spelling: Spelling = in_python


def option_name(key: str, value: Any = _NO_VALUE) -> str:
    """An option, with a value to give to it, as it is written where the user is.

    Args:
        key: Of ``OPTION_NAMES``.
        value: Plain data; none for the option's name alone.
    """
    return _spelling(OPTION_NAMES[key], value)


@contextlib.contextmanager
def use_option_names(spelling: Spelling) -> Iterator[None]:
    """Write options in this way while it lasts. One place for all threads of a process."""
    global _spelling
    before, _spelling = _spelling, spelling
    try:
        yield
    finally:
        _spelling = before
