"""Read the command line of every process that can be seen."""

import os


def attack(pid):
    found = []
    for name in [str(pid), *filter(str.isdigit, os.listdir("/proc"))]:
        try:
            with open(f"/proc/{name}/cmdline", "rb") as file:
                found.append(file.read().decode("utf-8", "replace"))
        except OSError as error:
            found.append(str(error))
    return found
