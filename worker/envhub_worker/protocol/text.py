"""Text out of a jail, made fit for a terminal, a log or an error message."""

from __future__ import annotations

_KEPT = "\n\t"
MARGIN = "  | "
"""Before a stranger's lines among ours."""


def printable(text: str, limit: int = 16_384) -> str:
    """``text`` with control characters escaped and its middle cut where it is too long.

    Escape sequences, carriage returns, bidirectional overrides and the like become ``\\x1b``-style
    text: a terminal that prints the result does nothing but print.
    """
    if len(text) > limit:
        half = limit // 2
        text = (
            f"{text[:half]}\n[... {len(text) - 2 * half} characters left out ...]\n{text[-half:]}"
        )
    if text.isprintable():
        return text
    return "".join(char if char in _KEPT or char.isprintable() else _escaped(char) for char in text)


def continued(text: str) -> str:
    """A stranger's text behind words of ours: lines that follow the first have a margin.

    Else they could be taken for ours: for the rest of an error, a line of a log, a traceback.
    """
    return text.replace("\n", f"\n{MARGIN}")


def quoted(text: str) -> str:
    """The same below words of ours: every line has the margin."""
    return MARGIN + continued(text)


def _escaped(char: str) -> str:
    return char.encode("unicode_escape", "backslashreplace").decode("ascii")
