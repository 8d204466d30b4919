"""Delete a file."""

import os


def attack(path):
    os.unlink(path)
