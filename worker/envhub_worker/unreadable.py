"""Tells what may not be read from what is not there: the import system calls both missing."""

from __future__ import annotations

import os
import stat
import sys


def why_hidden(module: str) -> str:
    """Why a module that was not found may be there all the same; empty if nothing hides it.

    Args:
        module: Its dotted name, as in ``ModuleNotFoundError.name``.
    """
    parent, _, last = module.rpartition(".")
    package = sys.modules.get(parent) if parent else None
    folders = sys.path if package is None else getattr(package, "__path__", ())
    steps = module.split(".") if package is None else [last]
    for folder in folders:
        for place in _candidates(str(folder) or ".", steps):
            closed = _closed(place)
            if closed:
                return closed
    return ""


def _candidates(folder: str, steps: list[str]) -> list[str]:
    """The folder, and what the module could be in it."""
    places = [os.path.join(folder, *steps[:depth]) for depth in range(len(steps) + 1)]
    return [*places, *(f"{place}.py" for place in places[1:])]


def _closed(path: str) -> str:
    """What keeps this process from reading a path, with its owner and mode; empty for nothing."""
    try:
        status = os.stat(path)
    except PermissionError:
        above = os.path.dirname(path)
        return _closed(above) or f"{path} may not be read by uid {os.geteuid()}"
    except OSError:
        return ""
    wanted = os.R_OK | os.X_OK if stat.S_ISDIR(status.st_mode) else os.R_OK
    if os.access(path, wanted):
        return ""
    return (
        f"{path} may not be read by uid {os.geteuid()}: it belongs to uid {status.st_uid} and has "
        f"mode {stat.S_IMODE(status.st_mode):04o}. What is missing may be installed there; if all "
        f"users may read it: chmod -R a+rX {path}"
    )
