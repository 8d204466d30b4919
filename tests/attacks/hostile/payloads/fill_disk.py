"""Fill every folder that takes something."""

import os
import tempfile

_PIECE = 1 << 20


def attack(folders, size):
    own = [os.environ.get("HOME", "/"), tempfile.gettempdir(), os.getcwd(), "/dev/shm"]
    written = {}
    for folder in folders or own:
        path = os.path.join(folder, f"fill-{os.getpid()}")
        done = 0
        try:
            with open(path, "wb", 0) as file:
                while done < size:
                    done += file.write(b"x" * _PIECE)
        except OSError as error:
            written[folder] = [path, done, str(error)]
        else:
            written[folder] = [path, done, ""]
    return written
