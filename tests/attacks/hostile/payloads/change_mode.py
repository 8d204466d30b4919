"""Change a file's permissions."""

import os


def attack(path):
    os.chmod(path, 0o666)
