"""Extras by their names: the core imports none, and does without one that is not there."""

from __future__ import annotations

import importlib
from types import ModuleType


def find_extra(name: str) -> ModuleType | None:
    """A module of ``extras``, by its name below it; None if this copy lacks it."""
    module = f"{__package__}.extras.{name}"
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # the module is there, and lacks something itself
        return None
