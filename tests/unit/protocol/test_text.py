"""Text out of a jail does nothing to a terminal."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from envhub_worker.protocol.text import printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain", "plain"),
        ("two\nlines\tand a tab", "two\nlines\tand a tab"),
        ("äöü 日本 🙂", "äöü 日本 🙂"),
        ("\x1b[2J", "\\x1b[2J"),
        ("\x1b]0;title\x07", "\\x1b]0;title\\x07"),
        ("over\rwritten", "over\\rwritten"),
        ("back\x08space", "back\\x08space"),
        ("nul\0", "nul\\x00"),
        ("\x9b31m", "\\x9b31m"),
        ("right \u202e to left", "right \\u202e to left"),
        ("zero\u200bwidth", "zero\\u200bwidth"),
        ("line\u2028separator", "line\\u2028separator"),
        ("half \ud800 surrogate", "half \\ud800 surrogate"),
        ("", ""),
    ],
)
def test_control_characters_are_shown_instead_of_obeyed(text: str, shown: str) -> None:
    """Escape sequences, carriage returns and overrides become text; words stay words."""
    assert printable(text) == shown


@given(st.text(st.characters(exclude_categories=())))
def test_nothing_unprintable_is_left(text: str) -> None:
    """Whatever comes in, only printable characters, line ends and tabs come out."""
    assert all(char in "\n\t" or char.isprintable() for char in printable(text))


@given(st.text(max_size=200), st.integers(2, 100))
def test_length_is_bounded(text: str, limit: int) -> None:
    """The middle of what is too long is left out, and the text says how much of it."""
    shown = printable("x" * len(text), limit)
    if len(text) <= limit:
        assert shown == "x" * len(text)
    else:
        assert shown.count("x") == limit // 2 * 2
        assert f"[... {len(text) - limit // 2 * 2} characters left out ...]" in shown


def test_beginning_and_end_are_kept() -> None:
    """The two ends of a long text are what one looks for."""
    shown = printable("first" + "." * 1000 + "last", 20)
    assert shown.startswith("first")
    assert shown.endswith("last")
