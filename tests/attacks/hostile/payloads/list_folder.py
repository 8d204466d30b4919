"""List a folder."""

import os


def attack(path):
    return os.listdir(path)
