"""Attach an attribute to a file."""

import os


def attack(path):
    os.setxattr(path, "user.attack", b"was here")
