"""Print without end."""

import os


def attack(size):
    line = b"x" * 8191 + b"\n"
    written = 0
    while written < size:
        written += os.write(1, line)
        written += os.write(2, line)
    return written
