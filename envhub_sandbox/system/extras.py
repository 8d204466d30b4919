"""Extras by their names: the core imports none, and does without one that is not installed."""

from __future__ import annotations

import importlib
from typing import Any

from envhub_sandbox.errors import SandboxUnavailableError


def find(module: str, name: str) -> Any:
    """What an extra's module calls so; None if this installation lacks the module."""
    try:
        return getattr(importlib.import_module(module), name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # the module is there, and lacks something itself
        return None


def required(module: str, name: str, what: str, instead: str = "leave that out") -> Any:
    """The same for what a caller has asked for. Raises ``SandboxUnavailableError``: it lacks it."""
    extra = find(module, name)
    if extra is None:
        raise SandboxUnavailableError(
            f"{what} needs {module}, which this installation of envhub-sandbox lacks: install the "
            f"whole package, or {instead}"
        )
    return extra
