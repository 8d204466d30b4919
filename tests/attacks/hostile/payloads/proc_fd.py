"""Open what another process has open, through /proc."""

import os


def attack(pid, fd):
    copy = os.open(f"/proc/{pid}/fd/{fd}", os.O_RDONLY)
    return os.pread(copy, 4096, 0).decode("ascii", "replace")
