"""Delete a file, whatever its folder's mode is."""

import contextlib
import os


def attack(path):
    with contextlib.suppress(OSError):
        os.chmod(os.path.dirname(path), 0o777)
    os.unlink(path)
