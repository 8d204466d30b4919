"""How an option of ``make_env`` is written in errors: in Python, for ``envhub``, and for LeRobot.

An error names an option by its key in ``options.py``. What reads a command line calls
``use_option_names``, so that errors use the words of that command line.
"""

from __future__ import annotations

import contextlib
import json
import shlex
from collections.abc import Callable, Collection, Iterator
from typing import Any

from envhub_sandbox.options import OPTIONS, Option

Spelling = Callable[[Option, Any], str]
_NO_VALUE = object()


def in_python(option: Option, value: Any) -> str:
    """``dependencies='host'``, ``policy={'profile': 'no-userns'}``."""
    if value is _NO_VALUE:
        return f"{option.argument}: {option.field}" if option.field else option.argument
    return f"{option.argument}={ {option.field: value} if option.field else value!r}"


def on_command_line(known: Collection[str]) -> Spelling:
    """``--dependencies host``, ``--profile no-userns``; in Python what a command does not have.

    Args:
        known: The options of the command.
    """

    def spelling(option: Option, value: Any) -> str:
        command = option.command.partition(" ")[0]
        if not command or command not in known or value is False:
            return f"{in_python(option, value)} in Python"
        if value is _NO_VALUE or value is True:
            return command
        return f"{command} {shlex.quote(_text(value))}"

    return spelling


def on_lerobots_command_line(prefix: str = "--env.") -> Spelling:
    """``--env.dependencies=host``, ``--env.policy='{"profile": "no-userns"}'``."""

    def spelling(option: Option, value: Any) -> str:
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
        key: Of ``OPTIONS``.
        value: Plain data; none for the option's name alone.
    """
    return _spelling(OPTIONS[key], value)


@contextlib.contextmanager
def use_option_names(spelling: Spelling) -> Iterator[None]:
    """Write options in this way while it lasts. One place for all threads of a process."""
    global _spelling
    before, _spelling = _spelling, spelling
    try:
        yield
    finally:
        _spelling = before
