"""Which environments of a repository a command is about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from envhub_sandbox.cli.shared.console import safe_line
from envhub_sandbox.cli.shared.exits import UsageError

_NAMED = 20


def select(
    envs: Mapping[str, Mapping[Any, Any]],
    suites: Sequence[str] | None,
    tasks: Sequence[str] | None,
) -> list[tuple[str, Any, Any]]:
    """``(suite, task, env)`` for each chosen environment; all where nothing is chosen.

    Raises:
        UsageError: None fits; the text names what there is.
    """
    found = [(suite, task, env) for suite, group in envs.items() for task, env in group.items()]
    chosen = [
        item
        for item in found
        if (not suites or str(item[0]) in suites) and (not tasks or str(item[1]) in tasks)
    ]
    if not chosen:
        names = ", ".join(safe_line(f"{suite}/{task}", 80) for suite, task, _ in found[:_NAMED])
        more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
        raise UsageError(f"no such suite or task; there are (suite/task): {names}{more}")
    return chosen
