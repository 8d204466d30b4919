"""Read what the kernel lists of a network namespace, by any folder of /proc that shows it."""

import os
import threading


def attack(name):
    tid = threading.get_native_id()
    ways = ["", "self/", "thread-self/", f"self/task/{tid}/", f"{os.getppid()}/", "1/"]
    return [_read(f"/proc/{way}net/{name}") for way in ways]


def _read(path):
    try:
        with open(path) as file:
            return file.read()
    except OSError as error:
        return f"{path}: {error}"
