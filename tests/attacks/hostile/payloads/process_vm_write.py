"""Write another process's memory without attaching to it."""

import ctypes

from payloads.kernel import syscall


def attack(pid, address, message):
    buffer = ctypes.create_string_buffer(message.encode())
    ours = (ctypes.c_ulong * 2)(ctypes.addressof(buffer), len(message))
    theirs = (ctypes.c_ulong * 2)(address, len(message))
    syscall("process_vm_writev", pid, ours, 1, theirs, 1, 0)
