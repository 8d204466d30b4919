"""Learn that a file exists, and its size, without opening it."""

import os


def attack(path):
    return os.stat(path).st_size
