"""Make a pipe as large as a plain user may."""

import fcntl
import os

kept = []


def attack(size):
    kept.append(os.pipe())
    fcntl.fcntl(kept[0][1], 1031, size)  # F_SETPIPE_SZ
