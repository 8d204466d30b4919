"""What render gives, held against the mode that it was asked in."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv

MODES = ("rgb_array", "rgb_array_list", "ansi")
"""Those that need no display, and of which one knows what they give."""

FILMED = ("rgb_array", "rgb_array_list")


def other_modes(env: VectorEnv[Any, Any, Any]) -> list[str]:
    """The modes that it declares and is not in. Trust: input from the worker."""
    declared = env.metadata.get("render_modes")
    given = declared if isinstance(declared, (list, tuple)) else ()
    named = {one for one in given if isinstance(one, str)}
    return [mode for mode in MODES if mode in named and mode != env.render_mode]


def wrong_frames(env: VectorEnv[Any, Any, Any]) -> Iterator[str]:
    """What its mode does not permit, of the first sub-environment that gives it."""
    mode = env.render_mode
    if mode not in MODES:
        return
    given = env.render()
    if not isinstance(given, (tuple, list)) or len(given) != env.num_envs:
        yield f"{mode}: render() gave {kind(given)}, not one result for each sub-environment"
        return
    for index, one in enumerate(given):
        if not _fits(one, mode):
            yield f"{mode}: sub-environment {index} gave {kind(one)}"
            return


def _fits(one: Any, mode: str) -> bool:
    if mode == "ansi":
        return isinstance(one, str)
    if mode == "rgb_array_list":
        return isinstance(one, (list, tuple)) and all(map(_is_frame, one))
    return _is_frame(one)


def _is_frame(frame: Any) -> bool:
    if not isinstance(frame, np.ndarray) or frame.dtype != np.uint8:
        return False
    return frame.ndim == 3 and frame.shape[2] == 3 and frame.size > 0


def kind(value: Any) -> str:
    """Its type and shape, in words."""
    return f"{getattr(value, 'dtype', type(value).__name__)} {getattr(value, 'shape', '')}".strip()
