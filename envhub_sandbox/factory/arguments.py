"""The plain arguments of ``make_env``, checked and made plain before anything is started."""

from __future__ import annotations

import operator
import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, SupportsIndex

import numpy as np

from envhub_sandbox.errors import PolicyError
from envhub_sandbox.option_names import option_name
from envhub_worker.protocol.limits import MAX_NUM_ENVS

_OURS = ("n_envs", "use_async_envs")


def sub_environments(n_envs: SupportsIndex) -> int:
    """How many there are to be; numpy's integers are taken, too.

    Raises:
        TypeError: It is no whole number.
        ValueError: Nobody can make so many.
    """
    count = _whole("n_envs", n_envs)
    if count < 1:
        raise ValueError("`n_envs` must be at least 1")
    if count > MAX_NUM_ENVS:
        raise ValueError(f"`n_envs` is {count}, and must be at most {MAX_NUM_ENVS}")
    return count


def workers(num_workers: SupportsIndex | None) -> int | None:
    """Over how many processes to spread them; raises as ``sub_environments`` does."""
    if num_workers is None:
        return None
    count = _whole("num_workers", num_workers)
    if count < 1:
        raise ValueError("`num_workers` must be at least 1, or None for as many as are useful")
    return count


def ahead(prewarm: SupportsIndex | None) -> int | None:
    """How many tasks are started before they are used; raises as ``sub_environments`` does."""
    if prewarm is None:
        return None
    count = _whole("prewarm", prewarm)
    if count < 0:
        raise ValueError("`prewarm` must be 0 or more, or None for what suits the way of use")
    return count


def _whole(name: str, value: SupportsIndex) -> int:
    try:
        return operator.index(value)
    except TypeError:
        raise TypeError(f"`{name}` is {value!r}; it takes a whole number") from None


def flag(name: str, value: object) -> bool:
    """A boolean of Python or numpy.

    Raises:
        TypeError: It is something else.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"`{name}` is {value!r}; it is True or False")
    return bool(value)


def keyword_arguments(env_kwargs: Mapping[str, Any] | None) -> dict[str, Any]:
    """Further arguments for the repository's ``make_env``.

    Raises:
        TypeError: They are no mapping of names, or hold what has an argument of its own.
    """
    if env_kwargs is None:
        return {}
    if not isinstance(env_kwargs, Mapping) or not all(type(name) is str for name in env_kwargs):
        raise TypeError(f"`env_kwargs` is {env_kwargs!r}; it takes a mapping of names to values")
    for name in _OURS:
        if name in env_kwargs:
            raise TypeError(f"`env_kwargs` holds {name!r}, which is an argument of its own")
    return dict(env_kwargs)


def only_in_a_sandbox(given: Mapping[str, object]) -> None:
    """Refuse what would silently do nothing, by name.

    Raises:
        PolicyError: Some of these were given.
    """
    idle = [name for name, value in given.items() if value]
    if idle:
        raise PolicyError(
            f"{', '.join(idle)}: for environments in a sandbox; with sandbox=None there is none"
        )


def interpreter(python: str | Path | None) -> str:
    """Its path, absolute; a name alone is looked up as a shell does. Empty for ours."""
    if python is None:
        return ""
    text = os.path.expanduser(python)
    found = shutil.which(text) if os.sep not in str(text) else None
    return os.path.abspath(found or text)


def check_executable(python: str) -> None:
    """Refuse an interpreter of this machine that cannot be run.

    Raises:
        PolicyError: It is not there, or is no program.
    """
    if python and not (os.path.isfile(python) and os.access(python, os.X_OK)):
        raise PolicyError(
            f"{option_name('python')} is {python!r}, which is no program; it takes the path of an "
            "interpreter, such as '.venv/bin/python'"
        )


def check_readable(paths: Iterable[str]) -> None:
    """Refuse to grant what is not on this machine: it would silently not be there.

    Raises:
        PolicyError: A path leads to nothing.
    """
    for path in paths:
        if not os.path.exists(path):
            raise PolicyError(
                f"{option_name('readable')} holds {path!r}, and there is no such file or folder on "
                "this machine"
            )
