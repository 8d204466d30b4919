"""Read another process's memory as a file."""

import os


def attack(pid, address, size):
    with open(f"/proc/{pid}/mem", "rb", 0) as memory:
        return os.pread(memory.fileno(), size, address).decode("ascii", "replace")
