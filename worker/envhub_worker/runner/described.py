"""Describes objects that the wire has no form for: spaces, specs and generators by plain values,
from which the client rebuilds them; the repository's exceptions by text.

Runs in the jail; the client checks every description.
"""

from __future__ import annotations

import builtins
import contextlib
import os
import sys
import traceback
from collections.abc import Iterator
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec

from envhub_worker.file_access import why_file_hidden, why_file_unwritable, why_no_terminal
from envhub_worker.protocol.codec.wire import GENERATOR, SPACE, SPEC
from envhub_worker.protocol.errors import EnvHubError
from envhub_worker.protocol.messages import RaisedException
from envhub_worker.protocol.spaces.spaces import BIT_GENERATORS, NUMBER, encode_space
from envhub_worker.protocol.text import printable
from envhub_worker.runner.state.space_numbers import SpaceNumbers

SPEC_FIELDS = ("id", "max_episode_steps", "reward_threshold", "nondeterministic")


def described(value: object) -> tuple[int, object] | None:
    """Returns the kind of an object and plain values to rebuild it; None without a description."""
    try:
        if isinstance(value, gym.Space):
            return SPACE, encode_space(value, seeded=True)
        if isinstance(value, EnvSpec):
            return SPEC, facts_of(value)
        if type(value) is np.random.Generator and type(value.bit_generator) in BIT_GENERATORS:
            return GENERATOR, value.bit_generator.state
    except (AttributeError, TypeError, ValueError, EnvHubError):
        pass  # an incomplete subclass: its repr is sent instead
    return None


def numbered(numbers: SpaceNumbers, value: object) -> tuple[int, object] | None:
    """Like ``described``, with the number of a space."""
    description = described(value)
    if description is None or description[0] != SPACE:
        return description
    return SPACE, {**cast("dict[str, Any]", description[1]), NUMBER: numbers.of(value)}


def facts_of(spec: Any) -> dict[str, Any]:
    """Returns a spec's facts about the environment, without how to make it."""
    return {name: getattr(spec, name, None) for name in SPEC_FIELDS}


_MAX_MESSAGE = 8_192
_MAX_TRACEBACK = 32_768
_GYMNASIUM = "gymnasium.error"
_OURS = os.path.dirname(os.path.dirname(os.path.abspath(__file__))) + os.sep
_IMPORTING = ("<frozen importlib.", f"{os.path.dirname(os.__file__)}{os.sep}importlib{os.sep}")


def raised(error: BaseException, stage: str, root: str = "") -> RaisedException:
    """The message for an exception: its nearest builtin ancestor, its text, its traceback.
    ``root``: the repository's folder, to which its files are named relative.
    """
    # Python imports an unreadable package as a namespace package, without its own file.
    why = ""
    nowhere = isinstance(error, ImportError) and error.path is None
    hidden = why_file_hidden(str(getattr(error, "name", ""))) if nowhere else ""
    if hidden:
        denied = PermissionError(f"{_text(error)}, but {hidden}")
        error = denied.with_traceback(error.__traceback__)
    with contextlib.suppress(Exception):  # the error may be of a class of the repository's
        why = _usage(error) or why_no_terminal(error) or why_file_unwritable(error, root)
    kind = type(error)
    name = kind.__qualname__
    if kind.__module__ not in ("builtins", "__main__"):
        name = f"{kind.__module__}.{name}"
    return RaisedException(
        builtin=_builtin(kind),
        type_name=printable(name, 512),
        message=printable(". ".join(filter(None, (_text(error), why))), _MAX_MESSAGE),
        traceback=printable(_traceback(error, root), _MAX_TRACEBACK),
        stage=stage,
    )


def _builtin(kind: type[BaseException]) -> str:
    """Names the nearest builtin ancestor of an error's class; Gymnasium's if that is Exception."""
    own = [base for base in kind.__mro__ if getattr(builtins, base.__name__, None) is base]
    theirs = [base for base in kind.__mro__ if base.__module__ == _GYMNASIUM]
    if theirs and own and own[0] is Exception:
        return f"{_GYMNASIUM}.{theirs[0].__name__}"
    return str(own[0].__name__) if own else "Exception"


def _text(error: BaseException) -> str:
    try:
        return str(error)
    except Exception:
        return "(its text could not be read)"


def _usage(error: BaseException) -> str:
    """Returns the usage text that argparse printed before it exited, if it did."""
    parsing = getattr(sys.modules.get("argparse"), "__file__", None)
    if not isinstance(error, SystemExit) or parsing is None:
        return ""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        if frame.f_code.co_name == "exit" and frame.f_code.co_filename == parsing:
            usage, why = frame.f_locals["self"].format_usage(), frame.f_locals.get("message")
            return f"argparse said: {usage}{why or ''}".rstrip()
    return ""


def _traceback(error: BaseException, root: str) -> str:
    """Returns the traceback without this package's frames, which called into the repository."""
    try:
        whole = traceback.TracebackException.from_exception(error, compact=True)
        for link in _chain(whole):
            _tell(link, root)
        return "".join(whole.format())
    except Exception:
        return ""


def _chain(whole: traceback.TracebackException) -> Iterator[traceback.TracebackException]:
    """Yields an exception and all exceptions that its traceback shows."""
    waiting, seen = [whole], set()
    while waiting:
        link = waiting.pop()
        if id(link) in seen:
            continue
        seen.add(id(link))
        yield link
        group = getattr(link, "exceptions", None) or ()
        waiting += [two for two in (link.__cause__, link.__context__, *group) if two is not None]


def _tell(link: traceback.TracebackException, root: str) -> None:
    """Drop frames outside the repository, and name its files relative to its folder."""
    theirs = [frame for frame in link.stack if not frame.filename.startswith((_OURS, *_IMPORTING))]
    syntax = getattr(link, "filename", None) is not None  # which tells its line without a frame
    if theirs or syntax:
        link.stack[:] = theirs
    for frame in link.stack:
        frame.filename = _in_repository(frame.filename, root)
    if syntax:
        link.filename = _in_repository(str(link.filename), root)


def _in_repository(name: str, root: str) -> str:
    return name.removeprefix(f"{root.rstrip(os.sep)}{os.sep}") if root else name
