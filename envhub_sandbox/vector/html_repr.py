"""HTML tables of environments for notebooks; everything that comes from a worker is escaped.

It sends no request: a picture shows the frame that the caller rendered last. Names and spaces come
from the worker, so they are bounded and escaped as text. Frames are arrays of numbers, and this
process encodes them.
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
    """A table of one environment, with its spaces and the layers that confine it.
    ``rendered``: what the first sub-environment rendered last; a frame is shown below the table.
    """
    held: dict[str, bool] = {}  # whether all workers enforce the layer
    for layer in layers:
        name = str(layer.get("layer"))
        held[name] = held.get(name, True) and bool(layer.get("enforced"))
    names = [name for name, holds in held.items() if holds]
    confined = f"{counted(len(names), 'layer')}: {', '.join(names)}"
    rows = [
        ("environments", env.num_envs),
        ("observations", env.single_observation_space),
        ("actions", env.single_action_space),
        ("state", "closed" if env.closed else "open"),
        ("confined by", confined if names else "(it does not run now)"),
    ]
    body = "".join(
        f"<tr><th>{_text(name)}</th><td>{_text(value)}</td></tr>" for name, value in rows
    )
    page = f"<code>{_text(repr(env))}</code><table>{body}</table>"
    if not is_frame(rendered):
        return page
    data = base64.b64encode(png(small_picture(rendered, _SIDE))).decode()
    return f'{page}<img alt="The last frame" src="data:image/png;base64,{data}">'


def suites_html(suites: Mapping[Any, Mapping[Any, Any]]) -> str:
    """A table of all environments, with a row for each."""
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
    # numpy aligns the numbers of a Box with several spaces, which HTML shows as one
    return html.escape(" ".join(one_line(str(value), _CHARS).split()))
