"""Install as many system call filters of the greatest length as the kernel takes, on one thread."""

import ctypes
import struct

from payloads.kernel import syscall

_PR_SET_NO_NEW_PRIVS, _PR_SET_SECCOMP, _FILTER = 38, 22, 2
_LENGTH = 4096
_LIBC = ctypes.CDLL(None, use_errno=True)


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_void_p))


def attack(way):
    load, allow = struct.pack("=HBBI", 0x20, 0, 0, 0), struct.pack("=HBBI", 6, 0, 0, 0x7FFF0000)
    code = ctypes.create_string_buffer(load * (_LENGTH - 1) + allow)
    program = _Program(_LENGTH, ctypes.addressof(code))
    _LIBC.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    count = 0
    while _installed(way, ctypes.addressof(program)):
        count += 1
    return count


def _installed(way, place):
    if way == "prctl":
        return _LIBC.prctl(_PR_SET_SECCOMP, _FILTER, ctypes.c_ulong(place), 0, 0) == 0
    try:
        return syscall("seccomp", 1, 0, place) == 0
    except OSError:
        return False
