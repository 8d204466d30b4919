"""Make another process's disk accesses wait for everybody else's."""

from payloads.kernel import syscall


def attack(pid, priority):
    syscall("ioprio_set", 1, pid, priority)
