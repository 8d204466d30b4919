"""Text that a terminal obeys, and what finds it."""

ESCAPES = "\x1b]0;owned\x07\x1b[2J\x9b31m\r\u202e"


def paints(text: str) -> bool:
    """Whether a terminal that prints the text would do more than print."""
    return any(not (char.isprintable() or char in "\n\t") for char in text)
