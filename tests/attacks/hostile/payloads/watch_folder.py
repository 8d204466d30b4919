"""Learn what others open in a folder that may only be read."""

import ctypes
import fcntl
import os
import select
import signal
import time

_LIBC = ctypes.CDLL(None, use_errno=True)
_IN_OPEN = 0x20


def attack(folder, way, seconds):
    return (_by_inotify if way == "inotify" else _by_signals)(folder, seconds)


def _by_inotify(folder, seconds):
    fd = _LIBC.inotify_init1(os.O_NONBLOCK)
    if fd < 0 or _LIBC.inotify_add_watch(fd, os.fsencode(folder), _IN_OPEN) < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    if not select.select([fd], [], [], seconds)[0]:
        return None
    return repr(os.read(fd, 4096))


def _by_signals(folder, seconds):
    came = []
    signal.signal(signal.SIGIO, lambda *_: came.append(1))
    fd = os.open(folder, os.O_RDONLY)
    wanted = fcntl.DN_ACCESS | fcntl.DN_MODIFY | fcntl.DN_CREATE | fcntl.DN_MULTISHOT
    fcntl.fcntl(fd, fcntl.F_NOTIFY, wanted)
    end = time.monotonic() + seconds
    while not came and time.monotonic() < end:
        time.sleep(0.05)
    return bool(came)
