"""Give a file to another group."""

import os


def attack(path, gid):
    os.chown(path, -1, gid)
