"""CURVE keys as text: 64 hexadecimal digits, or ZeroMQ's own Z85 (40 characters).

We print hexadecimal, which survives shells, YAML and a double click; Z85 has ``$``, ``#``, ``&``.
"""

from __future__ import annotations

import base64

KEY_BYTES = 32
_Z85 = "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ.-:+=^!/*?&<>()[]{}@%$#"
# Python's base 85 has the same digits under other names, and five characters that Z85 lacks.
_BASE85 = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz!#$%&()*+-;<=>?@^_`{|}~"
_TO_BASE85 = str.maketrans(_Z85, _BASE85, "".join(set(_BASE85) - set(_Z85)))
_Z85_CHARS = 40


def parse_key(text: str) -> bytes:
    """Returns the 32 bytes of a key.

    Raises:
        ValueError: The text is no key. The error does not repeat it, for it may be secret.
    """
    text = text.strip()
    try:
        is_z85 = len(text) == _Z85_CHARS
        key = base64.b85decode(text.translate(_TO_BASE85)) if is_z85 else bytes.fromhex(text)
    except ValueError:
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
