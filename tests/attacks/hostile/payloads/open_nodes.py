"""Open each of some device nodes: which of them could be opened, and why the others could not."""

import os


def attack(nodes):
    found = {}
    for path in nodes:
        try:
            os.close(os.open(path, os.O_RDWR | os.O_NONBLOCK))
            found[path] = "opened"
        except OSError as error:
            found[path] = error.strerror
    return found
