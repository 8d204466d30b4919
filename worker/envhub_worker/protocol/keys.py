"""CURVE keys as text: 64 hexadecimal digits, or ZeroMQ's own Z85 (40 characters).

We print hexadecimal, which survives shells, YAML and a double click; Z85 has ``$``, ``#``, ``&``.
"""

from __future__ import annotations

KEY_BYTES = 32
_Z85 = "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ.-:+=^!/*?&<>()[]{}@%$#"
_DIGITS = {character: value for value, character in enumerate(_Z85)}
_Z85_CHARS = 40


def parse_key(text: str) -> bytes:
    """Returns the 32 bytes of a key.

    Raises:
        ValueError: The text is no key. The error does not repeat it, for it may be secret.
    """
    text = text.strip()
    try:
        key = _from_z85(text) if len(text) == _Z85_CHARS else bytes.fromhex(text)
    except (KeyError, OverflowError, ValueError):
        key = b""
    if len(key) != KEY_BYTES:
        raise ValueError(
            f"a key has {2 * KEY_BYTES} hexadecimal digits, or {_Z85_CHARS} characters of Z85; "
            f"this has {len(text)} characters"
        )
    return key


def key_text(key: bytes) -> str:
    """Returns a key in hexadecimal, as all output of this project shows it."""
    return key.hex()


def _from_z85(text: str) -> bytes:
    groups = [text[start : start + 5] for start in range(0, len(text), 5)]
    return b"".join(_group(group).to_bytes(4, "big") for group in groups)


def _group(text: str) -> int:
    value = 0
    for character in text:
        value = value * 85 + _DIGITS[character]
    return value
