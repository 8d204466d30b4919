"""Extras by their names: the core imports none, and does without one that is not installed."""

from __future__ import annotations

import importlib
from typing import Any


def find(module: str, name: str) -> Any:
    """What an extra's module calls so; None if this installation lacks the module."""
    try:
        return getattr(importlib.import_module(module), name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # the module is there, and lacks something itself
        return None
