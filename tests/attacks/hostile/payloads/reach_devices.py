"""Open each of some nodes, list each of some folders, and map shared zeros: what came of it."""

import contextlib
import mmap
import os


def attack(nodes, folders):
    return {"nodes": nodes_read(nodes), "folders": listed(folders), "zeros": zeros()}


def nodes_read(nodes):
    found = {}
    for path in nodes:
        with contextlib.suppress(OSError):
            fd = os.open(path, os.O_RDWR)
            found[path] = os.read(fd, 64).decode()
            os.close(fd)
    return found


def listed(folders):
    found = {}
    for path in folders:
        with contextlib.suppress(OSError):
            found[path] = os.listdir(path)
    return found


def zeros():
    """Shared memory that no limit on pieces bounds; then all but a page leaves every account."""
    with contextlib.suppress(OSError):
        fd = os.open("/dev/zero", os.O_RDWR)
        mmap.mmap(fd, 8 << 20).write(b"x" * (8 << 20))
        return "mapped"
    return ""
