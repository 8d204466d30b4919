"""Put a new file somewhere, whatever its folder's mode is."""

import contextlib
import os


def attack(path, text):
    with contextlib.suppress(OSError):
        folder = os.path.dirname(path)
        os.chmod(folder, os.stat(folder).st_mode | 0o777)  # /tmp keeps its sticky bit
    with open(path, "w") as file:
        file.write(text)
