"""Read whatever files this process was born with."""

import os


def attack():
    found = []
    for fd in range(3, 256):
        try:
            found.append(os.pread(fd, 4096, 0).decode("utf-8", "replace"))
        except OSError:
            continue
    return found
