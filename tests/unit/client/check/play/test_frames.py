"""What render gives fits the mode, or is told by the sub-environment that gave it."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from envhub_sandbox.check.play.probes import other_modes, wrong_frames

FRAME = np.zeros((4, 6, 3), np.uint8)


@pytest.mark.parametrize(
    ("mode", "rendered", "said"),
    [
        ("rgb_array", (FRAME, FRAME), ""),
        ("rgb_array_list", [[FRAME], ()], ""),
        ("ansi", ("a", ""), ""),
        ("human", None, ""),
        ("rgb_array", FRAME, r"uint8 \(4, 6, 3\), not one result for each"),
        ("rgb_array", (FRAME, FRAME.astype(float)), "sub-environment 1 gave float64"),
        ("rgb_array", (FRAME[:0], FRAME), "sub-environment 0"),
        ("rgb_array_list", [[FRAME], FRAME], "sub-environment 1"),
        ("ansi", ("a", b"b"), "sub-environment 1 gave bytes"),
    ],
)
def test_frames_fit_their_mode(mode: str, rendered: Any, said: str) -> None:
    """Modes of which nobody knows what they give are not judged."""
    env: Any = SimpleNamespace(render_mode=mode, num_envs=2, render=lambda: rendered)
    found = list(wrong_frames(env))
    assert len(found) == bool(said)
    assert all(re.search(said, text) for text in found), found


@pytest.mark.parametrize("declared", [["ansi", "human", 3, "rgb_array"], ("rgb_array", "ansi")])
def test_modes_that_need_no_window_are_tried(declared: Any) -> None:
    """Of those that it declares; a lie about them names none."""
    env: Any = SimpleNamespace(metadata={"render_modes": declared}, render_mode="rgb_array")
    assert other_modes(env) == ["ansi"]
    assert other_modes(SimpleNamespace(metadata={"render_modes": 3}, render_mode=None)) == []  # type: ignore[arg-type]
