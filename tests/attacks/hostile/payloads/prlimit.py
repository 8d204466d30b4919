"""Lower another process's limits."""

import resource
import struct

from payloads.kernel import syscall


def attack(pid, files):
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    limits = struct.pack("=QQ", files, hard & (2**64 - 1))
    syscall("prlimit64", pid, resource.RLIMIT_NOFILE, limits, None)
