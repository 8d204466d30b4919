"""Finds extras by name: the core imports no extra directly and works without a missing one."""

from __future__ import annotations

import importlib
import os
from types import ModuleType

_HERE = os.path.join(os.path.dirname(os.path.abspath(__file__)), "extras", "__init__.py")


def find_extra(name: str) -> ModuleType | None:
    """Returns a module of ``extras`` by its name; None if this copy of the package lacks it."""
    if not os.path.exists(_HERE):  # the interpreter may have another copy, of another version
        return None
    module = f"{__package__}.extras.{name}"
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # the module is there, and lacks something itself
        return None
