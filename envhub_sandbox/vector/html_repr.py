"""HTML for notebooks: tables of environments, in which all that comes from a worker is escaped.

No request is sent. Names of suites and tasks and the spaces come from the manifest, and so from the
worker: they are bounded here, and are text, never markup.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping
from typing import Any

from envhub_worker.protocol.codec.inert import one_line

_CHARS = 300
_ROWS = 50
_HEAD = ("suite", "task", "environments", "observations", "actions")


def environment_html(env: Any, layers: Iterable[Mapping[str, Any]]) -> str:
    """A table of one environment: its spaces, and the layers that confine it."""
    names = [str(layer.get("layer")) for layer in layers if layer.get("enforced")]
    rows = [
        ("environments", env.num_envs),
        ("observations", env.single_observation_space),
        ("actions", env.single_action_space),
        ("state", "closed" if env.closed else "open"),
        ("confined by", ", ".join(names) or "(it does not run now)"),
    ]
    body = "".join(
        f"<tr><th>{_text(name)}</th><td>{_text(value)}</td></tr>" for name, value in rows
    )
    return f"<code>{_text(repr(env))}</code><table>{body}</table>"


def suites_html(suites: Mapping[Any, Mapping[Any, Any]]) -> str:
    """A table of all environments, a line each."""
    lines = [(suite, task, env) for suite, tasks in suites.items() for task, env in tasks.items()]
    rows = "".join(map(_row, lines[:_ROWS]))
    more = f"<p>and {len(lines) - _ROWS} more</p>" if len(lines) > _ROWS else ""
    head = "".join(f"<th>{name}</th>" for name in _HEAD)
    return f"<table><tr>{head}</tr>{rows}</table>{more}"


def _row(line: tuple[Any, Any, Any]) -> str:
    suite, task, env = line
    spaces = (env.single_observation_space, env.single_action_space)
    cells = (suite, repr(task), env.num_envs, *spaces)
    return f"<tr>{''.join(f'<td>{_text(cell)}</td>' for cell in cells)}</tr>"


def _text(value: object) -> str:
    return html.escape(one_line(str(value), _CHARS))
