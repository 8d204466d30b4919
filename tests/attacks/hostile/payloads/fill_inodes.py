"""Create empty files until there are no more to be had."""

import os
import tempfile


def attack(folders, count):
    own = [os.environ.get("HOME", "/"), tempfile.gettempdir(), os.getcwd(), "/dev/shm"]
    made = {}
    for folder in folders or own:
        try:
            place = tempfile.mkdtemp(dir=folder)
            made[folder] = [place, 0, ""]
            for index in range(count):
                os.close(os.open(f"{place}/{index}", os.O_CREAT | os.O_WRONLY, 0o600))
                made[folder][1] += 1
        except OSError as error:
            made.setdefault(folder, ["", 0, ""])[2] = str(error)
    return made
