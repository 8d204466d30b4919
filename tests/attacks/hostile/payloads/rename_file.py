"""Move a file away."""

import os


def attack(path):
    os.rename(path, path + ".gone")
