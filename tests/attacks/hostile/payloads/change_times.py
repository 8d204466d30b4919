"""Change when a file was last used, as builds and backups look at it."""

import os


def attack(path):
    os.utime(path, (1, 1))
