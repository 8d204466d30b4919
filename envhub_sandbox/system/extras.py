"""Finds extras by name. The core imports no extra, and works without those not installed."""

from __future__ import annotations

import importlib
from typing import Any

from envhub_sandbox.errors import SandboxUnavailableError


def find(module: str, name: str) -> Any:
    """An attribute of an extra's module; None if this installation lacks the module."""
    try:
        return getattr(importlib.import_module(module), name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # the module exists, and one of its own imports is missing
        return None


def required(module: str, name: str, what: str, instead: str = "leave that out") -> Any:
    """``find`` for a caller's request. Raises ``SandboxUnavailableError``: it is missing."""
    extra = find(module, name)
    if extra is None:
        raise SandboxUnavailableError(
            f"{what} needs {module}, which this installation of envhub-sandbox lacks: install the "
            f"whole package, or {instead}"
        )
    return extra
