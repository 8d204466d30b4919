"""HTML for notebooks: tables of environments, in which all that comes from a worker is escaped.

No request is sent: a picture shows the frame that the caller rendered last. Names and spaces come
from the worker: they are bounded, and escaped as text. Frames are numbers, encoded here.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Mapping
from typing import Any

from envhub_sandbox.vector.pictures import is_frame, png, small_picture
from envhub_worker.protocol.codec.inert import one_line
from envhub_worker.protocol.text import counted

_CHARS = 300
_ROWS = 50
_SIDE = 256
"""Pixels of a picture."""
_HEAD = ("suite", "task", "environments", "observations", "actions")


def environment_html(env: Any, layers: Iterable[Mapping[str, Any]], rendered: Any = None) -> str:
    """A table of one environment: its spaces, and the layers that confine it.
    ``rendered``: by the first sub-environment; a frame is shown below the table.
    """
    held: dict[str, bool] = {}  # by each of its workers
    for layer in layers:
        name = str(layer.get("layer"))
        held[name] = held.get(name, True) and bool(layer.get("enforced"))
    names = [name for name, holds in held.items() if holds]
    rows = [
        ("environments", env.num_envs),
        ("observations", env.single_observation_space),
        ("actions", env.single_action_space),
        ("state", "closed" if env.closed else "open"),
        ("confined by", _counted(names) if names else "(it does not run now)"),
    ]
    body = "".join(
        f"<tr><th>{_text(name)}</th><td>{_text(value)}</td></tr>" for name, value in rows
    )
    return f"<code>{_text(repr(env))}</code><table>{body}</table>{_picture(rendered)}"


def _counted(layers: list[str]) -> str:
    return f"{counted(len(layers), 'layer')}: {', '.join(layers)}"


def _picture(rendered: Any) -> str:
    """A frame as a small picture; nothing of anything else."""
    if not is_frame(rendered):
        return ""
    data = base64.b64encode(png(small_picture(rendered, _SIDE))).decode()
    return f'<img alt="The last frame" src="data:image/png;base64,{data}">'


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
    # numpy aligns the numbers of a Box with spaces, of which HTML shows one
    return html.escape(" ".join(one_line(str(value), _CHARS).split()))
