"""Text out of a jail, made fit for a terminal, a log or an error message."""

from __future__ import annotations

_KEPT = "\n\t"


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


def _escaped(char: str) -> str:
    return char.encode("unicode_escape", "backslashreplace").decode("ascii")
