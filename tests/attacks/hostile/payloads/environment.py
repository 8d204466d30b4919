"""Read the environment that this process was started with."""

import os


def attack():
    with open("/proc/self/environ", "rb") as file:
        return [dict(os.environ), file.read().decode("utf-8", "replace")]
