"""What a stranger's function takes, without calling it."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

Parameters = dict[str, inspect.Parameter]


def parameters_of(function: Callable[..., Any]) -> Parameters | None:
    """The parameters by name; None where Python cannot tell."""
    try:
        return dict(inspect.signature(function).parameters)
    except (TypeError, ValueError):
        return None


def takes(parameters: Parameters, name: str) -> bool:
    """Whether a keyword argument of this name can be given."""
    return names(parameters, name) or any(
        item.kind is inspect.Parameter.VAR_KEYWORD for item in parameters.values()
    )


def names(parameters: Parameters, name: str) -> bool:
    """Whether it has a parameter of this name, which can be given by keyword."""
    parameter = parameters.get(name)
    return parameter is not None and parameter.kind is not inspect.Parameter.POSITIONAL_ONLY
