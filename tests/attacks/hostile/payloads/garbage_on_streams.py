"""Write noise to every socket that this process was given."""

import os
import stat


def attack(data):
    raw = bytes.fromhex(data)
    for fd in range(3, 256):
        try:
            if stat.S_ISSOCK(os.fstat(fd).st_mode):
                os.write(fd, raw)
        except OSError:
            continue
