"""Hold something of a file that may only be read, so that others wait."""

import fcntl
import os
import signal

kept = []
_F_SETLEASE, _F_WRLCK = 1024, 1


def attack(path, way):
    signal.signal(signal.SIGIO, signal.SIG_IGN)
    fd = os.open(path, os.O_RDONLY)
    kept.append(fd)
    if way == "lease":
        fcntl.fcntl(fd, _F_SETLEASE, _F_WRLCK)
    else:
        fcntl.flock(fd, fcntl.LOCK_EX)
