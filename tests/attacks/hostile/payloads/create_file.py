"""Put a new file somewhere, whatever its folder's mode is."""

import contextlib
import os


def attack(path, text):
    with contextlib.suppress(OSError):
        os.chmod(os.path.dirname(path), 0o777)
    with open(path, "w") as file:
        file.write(text)
